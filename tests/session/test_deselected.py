"""What is damaged stays red, and what is known stays known, however items are selected or run."""

import pytest

KEEP_SAMPLES = """
def pytest_collection_modifyitems(config, items):
    gone = [item for item in items if "test_listing" in item.nodeid]
    items[:] = [item for item in items if item not in gone]
"""

SELECTIONS = {
    "-k": ("-k", "test_sample"),
    "-k not": ("-k", "not test_listing"),
    "-k name": ("-k", "bowl"),
    "--deselect": ("--deselect", "cpas::test_listing"),
    "--deselect id": ("--deselect", "cpas::test_listing[perfect-tiny]"),
    "-m": ("-m", "not_a_mark or not listing", "-p", "marks"),
    "plugin": ("-p", "keeps"),
}


@pytest.fixture
def damaged(cpas, pytester):
    """Run the perfect method on a data set whose listing is damaged."""
    pytester.makepyfile(
        keeps=KEEP_SAMPLES,
        marks="""
        import pytest
        def pytest_configure(config):
            config.addinivalue_line("markers", "listing: the listing")
            config.addinivalue_line("markers", "not_a_mark: nothing")
        @pytest.hookimpl(tryfirst=True)
        def pytest_collection_modifyitems(items):
            for item in items:
                if "test_listing" in item.nodeid:
                    item.add_marker("listing")
        """,
    )
    pytester.syspathinsert()
    return lambda *args: cpas("Perfect", *args, dataset="Damaged")


@pytest.mark.thinned(3)
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=["alone", "-n2"])
@pytest.mark.parametrize("selection", SELECTIONS)
def test_damaged_listing_is_told(damaged, selection, how):
    result = damaged(*SELECTIONS[selection], *how)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["FAILED cpas::test_listing[[]perfect-tiny] - *scene_9/0000_meta*"])
    assert result.parseoutcomes()["failed"] == 1


@pytest.mark.parametrize("option", ["--lf", "--sw"])
def test_damaged_listing_is_told_where_a_run_goes_on(cpas, damaged, option):
    cached = ("-p", "cacheprovider", "-p", "stepwise", option)
    assert cpas("Raises", *cached).ret != 0  # where the listing was not damaged yet
    result = damaged(*cached)
    assert result.ret == 1
    assert result.parseoutcomes()["deselected"]
    result.stdout.fnmatch_lines(["FAILED cpas::test_listing[[]perfect-tiny] - *scene_9/0000_meta*"])


def test_damaged_listing_is_told_once(damaged):
    result = damaged()
    assert result.parseoutcomes()["failed"] == 1


def test_nothing_is_recorded_of_it(damaged, pytester):
    result = damaged("-k", "not test_listing", "--snapshot-update")
    assert result.ret == 1
    assert not list((pytester.path / "golden").iterdir())


DROPS = """
def pytest_collection_modifyitems(items):
    items[:] = [item for item in items if "bowl" not in item.nodeid]
"""


@pytest.mark.thinned(2)
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=["alone", "-n2"])
def test_a_category_that_a_plugin_leaves_out_is_asked_for(cpas, pytester, how):
    """Nobody named it: it is not checked, and not "not asked for"."""
    assert cpas("Perfect", "--snapshot-update").ret == 0
    pytester.makepyfile(drops=DROPS)
    pytester.syspathinsert()
    result = cpas("Perfect", "-p", "drops", "--cpas-require-golden", *how)
    assert result.ret == 1
    assert "not asked for" not in result.stdout.str()
    result.stdout.fnmatch_lines(["*NOT CHECKED bowl*"])
    named = cpas("Perfect", "-k", "not bowl", "--cpas-require-golden", *how)
    assert named.ret == 0
