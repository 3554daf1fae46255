"""The documentation's pages in a browser, opened as files: ``nox -s docs browser``."""

import pytest
from browser_report import Browser
from docs_pages import MADE, ROOT, pages

SITE = ROOT / "site"

SEARCH = """
const field = document.querySelector('.md-search__input');
document.querySelector('[data-md-toggle=search]').click();
field.value = 'nocs legacy';
for (const name of ['focus', 'keyup', 'input'])
    field.dispatchEvent(new Event(name, {bubbles: true}))
"""
FOUND = "[...document.querySelectorAll('.md-search-result__link')].map(link => link.href)"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if not (SITE / "index.html").is_file():
        pytest.skip("there is no site; nox -s docs builds it")
    made = Browser(tmp_path_factory.mktemp("profile"))
    yield made
    made.close()


@pytest.mark.parametrize("name", [*pages(), *MADE])
def test_page_fits_a_phone_and_needs_nothing(browser, name):
    del browser.console[:], browser.requests[:]
    browser.show((SITE / name).with_suffix(".html").as_uri(), 390)
    assert browser.run("document.documentElement.scrollWidth") <= 390
    assert browser.console == []
    assert {url.partition(":")[0] for url in browser.requests} <= {"file", "about", "data"}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_are_the_systems(browser, scheme):
    browser.show((SITE / "index.html").as_uri(), scheme=scheme)
    wanted = {"light": "default", "dark": "slate"}[scheme]
    assert browser.run("document.body.dataset.mdColorScheme") == wanted


def test_search_works_without_a_server(browser):
    del browser.console[:]
    browser.show((SITE / "index.html").as_uri())
    browser.run(SEARCH)
    for _ in range(2000):  # each takes the browser a moment
        if found := browser.run(FOUND):
            break
    assert found[0].endswith("reference/metrics.html")
    assert any(link.endswith("#pytest_cpas.metrics.nocs_legacy_iou") for link in found)
    assert browser.console == []
