"""The page of a report in a browser: ``nox -s browser``, which needs Chromium (or Chrome).

It is driven through its own protocol over a pipe, so that no driver has to be installed.
"""

import base64
import itertools
import json
import os
import shutil
import subprocess
from dataclasses import replace
from urllib.parse import urlencode

import numpy as np
import pytest
from tables import CPAS, a_parity

from pytest_cpas.evaluation import Answer, Row, Run
from pytest_cpas.facts import fact
from pytest_cpas.golden import RunTable, find_golden, shipped_golden
from pytest_cpas.golden.comparison import compare
from pytest_cpas.report.against import against
from pytest_cpas.report.document import document, run_document
from pytest_cpas.report.files import write_report
from pytest_cpas.report.panels import ValuePictures
from pytest_cpas.report.value_pictures import value_pictures
from pytest_cpas.types import SampleRef

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


class Browser:
    """A headless browser with one page, and what that wrote to its console."""

    def __init__(self, folder):
        program = next(filter(None, map(shutil.which, NAMES)), None)
        assert program, f"none of {', '.join(NAMES)} is installed"
        ours, theirs = os.pipe(), os.pipe()
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe"]
        self.process = subprocess.Popen(
            [program, *options, f"--user-data-dir={folder}", "about:blank"],
            preexec_fn=lambda: (os.dup2(ours[0], 3), os.dup2(theirs[1], 4)),
            pass_fds=(3, 4),
            stderr=subprocess.DEVNULL,
        )
        os.close(ours[0])
        os.close(theirs[1])
        self.to, self.back, self.received = os.fdopen(ours[1], "wb", 0), theirs[0], b""
        self.numbers, self.session = itertools.count(1), None
        self.console, self.requests = [], []
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(t["targetId"] for t in targets if t["type"] == "page")
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def message(self):
        while b"\0" not in self.received:
            part = os.read(self.back, 1 << 20)
            assert part, "the browser is gone"
            self.received += part
        text, _, self.received = self.received.partition(b"\0")
        return json.loads(text)

    def call(self, method, **parameters):
        number = next(self.numbers)
        request = {"id": number, "method": method, "params": parameters}
        if self.session:
            request["sessionId"] = self.session
        self.to.write(json.dumps(request).encode() + b"\0")
        while (answer := self.message()).get("id") != number:
            event = answer.get("method")
            if event in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
                self.console.append(answer["params"])
            if event == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])
        assert "error" not in answer, answer
        return answer["result"]

    def run(self, script):
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def show(self, address, width=1280, height=900, scheme="light"):
        media = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", features=media)
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=address)
        while self.run("document.readyState") != "complete":
            pass

    def close(self):
        self.to.close()
        self.process.terminate()
        self.process.wait()
        os.close(self.back)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    made = Browser(tmp_path_factory.mktemp("profile"))
    yield made
    made.close()


class Stored(Run):
    def judge(self, ref):
        raise NotImplementedError


def stored_run(name, spoil, method="icp"):
    """The recorded run of icp on a data set, spoiled, against its golden table."""
    golden = find_golden(shipped_golden(), "icp", name)
    refs = [
        SampleRef(id=sample, category=it.category, scene="s")
        for sample, it in golden.samples.items()
    ]
    run = Stored("icp", name, refs, identity=golden.identity)
    run.method = method  # a stored report can have any
    run.seeds = golden.seeds
    judged = [
        spoil(index, Row(sample=sample, category=it.category, answers=it.answers))
        for index, (sample, it) in enumerate(golden.samples.items())
    ]
    torn = [judged.pop(5).sample] if judged[0].failure else []
    errors = dict.fromkeys(torn, "</script><script>document.title = 'hacked'</script>")
    table = RunTable.of(run, judged)
    return run_document(
        run,
        table,
        errors=errors,
        verdicts=compare(golden, table),
        require_golden=False,
        contract=[],
        findings=[],
        golden=golden,
    )


def spoiled(index, row):
    if index % 7 == 0:
        reason = "<img src=x onerror=\"document.title = 'hacked'\">"
        lost = {name: fact(name).failed for name in row.facts}
        return with_answer(row, Answer(facts=lost, failure=reason))
    return turned(row, 2.5 if index % 5 == 0 else 1)


def better(index, row):
    return turned(row, 0.3 if index % 4 == 0 else 1)


def worse(index, row):
    return turned(row, 20 if index % 6 == 0 else 1)


def turned(row, factor):
    """With another rotation error."""
    error = row.facts["rotation_deg"] * factor
    facts = {**row.facts, "rotation_deg": min(180.0, error) if factor > 1 else error}
    return with_answer(row, Answer(facts=facts, failure=row.failure))


def with_answer(row, answer):
    """With another answer under every seed."""
    return replace(row, answers=(answer,) * len(row.answers))


@pytest.fixture(scope="module")
def content():
    hostile = "<img src=x onerror=\"document.title = 'hacked'\">"
    runs = [
        stored_run("synthetic-tabletop", lambda index, row: row),
        stored_run("synthetic-handheld", spoiled),
        stored_run("synthetic-tabletop", better, hostile),
        stored_run("synthetic-handheld", better, hostile),
    ]
    runs[1]["parity"] = a_parity()
    made = document(runs, 1, CPAS)
    old = [stored_run("synthetic-handheld", better), stored_run("synthetic-tabletop", worse)]
    made["against"] = against(runs, old)
    return made


@pytest.fixture(scope="module")
def address(content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    random = np.random.default_rng(0)
    ball = random.standard_normal((1, 600, 3))
    ball /= np.linalg.norm(ball, axis=2, keepdims=True)
    moved = ball + (ball[..., :1] > 0.8) * [0.0, 0.5, 0.2]
    waves = np.sin(np.arange(5 * 40 * 60).reshape(5, 40, 60) / 100)
    drawn = [value_pictures(moved, ball), value_pictures(np.roll(waves, 2, 1), waves)]
    rows = [row for each in drawn for row in each.rows]
    pictures = ValuePictures(rows=rows, remarks=drawn[0].remarks)
    write_report(content, folder, {}, {("icp", "synthetic-handheld"): pictures})
    return (folder / "report.html").as_uri()


def names(browser):
    return browser.run(
        "[...document.querySelectorAll('#samples tr td:first-child')].map(td => td.textContent)"
    )


VERDICTS = {
    "": lambda s, i: True,
    "lost": lambda s, i: s["outcome"] and s["golden"][i] + s["outcome"][i] == "10",
    "gained": lambda s, i: s["outcome"] and s["golden"][i] + s["outcome"][i] == "01",
    "correct": lambda s, i: s["outcome"] and s["outcome"][i] == "1",
    "not correct": lambda s, i: s["outcome"] and s["outcome"][i] == "0",
    "no answer": lambda s, i: s["failure"] is not None,
    "not judged": lambda s, i: s["error"] is not None,
}


@pytest.mark.parametrize("category", ["", "mug"])
@pytest.mark.parametrize("verdict", list(VERDICTS))
def test_filters_of_a_shared_link(browser, address, content, verdict, category):
    label = "5 deg, 1 cm"
    run = content["runs"][0]
    name = f"icp on {run['dataset']}"
    given = {"run": name, "category": category, "verdict": verdict, "at": label}
    browser.show(f"{address}#{urlencode({k: v for k, v in given.items() if v})}")
    index = content["thresholds"].index(label)
    expected = [
        s["sample"]
        for s in run["samples"]
        if category in ("", s["category"]) and VERDICTS[verdict](s, index)
    ]
    assert expected or verdict == "gained" or category
    assert names(browser) == expected
    assert browser.run("document.getElementById('told').textContent").startswith(
        f"{len(expected)} of "
    )


@pytest.mark.parametrize("kind", ["lost", "gained"])
def test_filters_of_what_changed_since_another_run(browser, address, content, kind):
    """As a link of the comparison sets them, and with a category on top."""
    browser.show(address)
    browser.run(
        "[...document.querySelectorAll('h2#against ~ p a')].find("
        f"a => a.textContent.endsWith(' {kind} since')).click()"
    )
    browser.run("dispatchEvent(new HashChangeEvent('hashchange'))")
    pair = next(pair for pair in content["against"]["pairs"] if any(f[kind] for f in pair["flips"]))
    expected = [flip["sample"] for flip in pair["flips"] if flip[kind]]
    assert expected
    assert names(browser) == expected
    assert browser.run("location.hash").endswith(f"verdict={kind}+since")
    browser.show(f"{address}#{urlencode({'verdict': f'{kind} since', 'category': 'mug'})}")
    mugs = {
        flip["sample"]
        for pair in content["against"]["pairs"]
        for flip in pair["flips"]
        if flip[kind] and flip["category"] == "mug"
    }
    assert set(names(browser)) == mugs


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_two_data_sets_at_a_time(browser, address, width, scheme):
    """Dots and their names are inside the charts; what was not timed is grey in both schemes."""
    browser.show(address, width, scheme=scheme)
    charts = "[...document.querySelectorAll('.overview .chart svg')]"
    assert browser.run(f"{charts}.map(c => c.querySelectorAll('.dot.measured').length)") == [2] * 4
    assert browser.run(
        f"{charts}.every(c => [...c.querySelectorAll('.dot, .name')].every(n => {{"
        "  const [a, b] = [n.getBoundingClientRect(), c.getBoundingClientRect()];"
        "  return a.left >= b.left && a.right <= b.right && a.top >= b.top && a.bottom <= b.bottom;"
        "}))"
    )
    fill = browser.run("getComputedStyle(document.querySelector('.dot.measured')).fill")
    red, green, blue = map(int, fill.removeprefix("rgb(").strip(")").split(","))
    assert max(red, green, blue) - min(red, green, blue) < 30
    described = browser.run(f"{charts}[0].querySelector('desc').textContent")
    assert "icp: " in described
    assert "not timed" in described


def test_choosing_changes_list_and_link_and_a_link_of_a_card_the_list(browser, address, content):
    browser.show(address)
    total = sum(len(run["samples"]) for run in content["runs"])
    assert len(names(browser)) == 200 < total
    for shown in (400, total):
        browser.run("document.getElementById('more').click()")
        assert len(names(browser)) == shown
    browser.run(
        "const field = document.forms[0].elements.category; field.value = 'can';"
        "field.dispatchEvent(new Event('input', {bubbles: true}))"
    )
    cans = [s for run in content["runs"] for s in run["samples"] if s["category"] == "can"]
    assert names(browser) == [s["sample"] for s in cans]
    assert browser.run("location.hash") == "#category=can"
    browser.run(
        "[...document.querySelectorAll('.card a')].find("
        "a => a.textContent.endsWith(' lost')).click()"
    )
    browser.run("dispatchEvent(new HashChangeEvent('hashchange'))")
    lost = [flip["sample"] for flip in content["runs"][0]["flips"] if flip["lost"]]
    assert names(browser) == lost
    browser.run("document.getElementById('clear').click()")
    assert len(names(browser)) == 200
    assert browser.run("location.hash") == ""


def test_worst_first(browser, address, content):
    browser.show(f"{address}#order=worst&run=icp+on+synthetic-handheld")
    run = content["runs"][0]
    outcomes = {s["sample"]: s["outcome"] for s in run["samples"]}
    met = [-1 if outcomes[n] is None else outcomes[n].count("1") for n in names(browser)]
    assert met == sorted(met)
    assert len(met) == len(run["samples"])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_pictures_of_values(browser, address, width, scheme):
    """Three beside each other, all decoded, none wider than the screen, each with its scale."""
    browser.show(address, width, scheme=scheme)
    images = "[...document.querySelectorAll('.values img')]"
    assert browser.run(f"{images}.map(i => i.naturalWidth)") == [256] * 3 + [240] * 9
    ends = browser.run(
        f"{images}.map(i => [i.getBoundingClientRect()].map(r => [r.x, r.right])[0])"
    )
    tops = browser.run(f"{images}.map(i => i.getBoundingClientRect().y)")
    assert all(0 <= left < right <= width for left, right in ends)
    assert [tops[i] for i in (1, 2)] == [tops[0]] * 2
    bars = "[...document.querySelectorAll('.values .ramp > span')]"
    assert browser.run(f"{bars}.every(b => b.getBoundingClientRect().width > 60)")
    assert len(browser.run(f"{bars}.map(b => getComputedStyle(b).backgroundImage)")) == 11


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_looks(browser, address, width, scheme, tmp_path_factory):
    """Readable in both schemes, nothing wider than the screen; the pictures are kept to look at."""
    browser.show(address, width, scheme=scheme)
    assert browser.run("document.documentElement.scrollWidth") <= width
    colours = browser.run(
        "const style = getComputedStyle(document.body); [style.color, style.backgroundColor]"
    )
    ink, ground = (sum(map(float, colour.strip("rgb()").split(","))) / 3 for colour in colours)
    assert (ink < 60 and ground > 240) if scheme == "light" else (ink > 200 and ground < 60)
    if folder := os.environ.get("CPAS_TEST_PICTURES"):
        answer = browser.call("Page.captureScreenshot", captureBeyondViewport=True)
        path = os.path.join(folder, f"report-{width}-{scheme}.png")
        with open(path, "wb") as file:
            file.write(base64.b64decode(answer["data"]))


def test_nothing_is_loaded_run_or_complained_about(browser, address):
    """After all of the above: no console message, no request but for the page."""
    browser.show(address)
    assert "hacked" not in browser.run("document.title")
    assert browser.console == []
    others = {url.partition("#")[0] for url in browser.requests} - {address, "about:blank"}
    assert {url.partition(",")[0] for url in others} == {"data:image/webp;base64"}
