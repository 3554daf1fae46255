"""The documentation says what the code does: options, metrics, checks, verdicts, examples."""

import ast
import importlib.metadata
import itertools
import json
import pkgutil
import re
import tomllib

import make_properties
import pytest
from docs_pages import (
    DOCS,
    MADE,
    ROOT,
    anchors,
    blocks,
    code,
    column,
    links,
    pages,
    section,
    text,
)
from reference import PARTS

from pytest_cpas import metrics
from pytest_cpas._deprecation import MOVED
from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.checks.dataset import CHECKS
from pytest_cpas.checks.dataset.verdicts import DatasetWord
from pytest_cpas.checks.metrics import KNOWN, PROPERTIES
from pytest_cpas.checks.metrics.running import DEFAULT_EXAMPLES
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.cli import main
from pytest_cpas.golden.words import Word
from pytest_cpas.metrics import DEFINITIONS
from pytest_cpas.timing.verdicts import SpeedWord
from pytest_cpas.traces.parity import ParityWord

README = (ROOT / "README.md").read_text(encoding="utf-8")
BY_ENVIRONMENT = ("cpas_data", "cpas_weights")
#: Defaults that the parser does not hold.
ELSEWHERE = {
    "cpas_batch": "as many as each declares",
    "cpas_alarm": "ini cpas_alarm, else 1/1000",
    "cpas_examples": str(DEFAULT_EXAMPLES),
    "cpas_golden": "ini cpas_golden, else golden/ in the root directory",
    "cpas_timeout": "ini cpas_timeout, else any time",
    "cpas_trace_max": "64",
}


@pytest.fixture(scope="module")
def defaults(request):
    """The plugin's options and their defaults, as pytest's own parser knows them here."""
    options = vars(request.config.option)
    return {name: value for name, value in options.items() if name.startswith("cpas_")}


def option(name):
    return "--" + name.replace("_", "-")


def test_every_option_is_in_the_reference_with_its_default(defaults):
    page = text("reference/options.md")
    described = re.findall(r"^### (--cpas-[a-z-]+)", page, re.MULTILINE)
    assert sorted(described) == sorted(map(option, defaults))
    for name, value in defaults.items():
        told = section(page, name.replace("_", "-"))
        (shown,) = re.findall(r"^Default: (.+?)[.;]", told, re.MULTILINE)
        if name in BY_ENVIRONMENT:
            assert shown == f"environment variable {name.upper()}"
        elif value in (None, []):
            assert shown == ELSEWHERE.get(name, "none")
        else:
            assert shown == ("off" if value is False else f"`{value}`")


def test_the_reference_says_what_pytest_help_says(pytester, defaults):
    helped = pytester.runpytest_inprocess("-p", "no:dash", "--help").stdout.str()
    # what is repeatable and which default it has stands in a line of its own
    helped = re.sub(r" \((default: [^)]*|repeatable)\)", "", " ".join(helped.split()))
    page = text("reference/options.md")
    for name in map(option, defaults):
        told = section(page, name.strip("-")).strip().partition("\n\n")[0]
        said = re.escape(told[0].lower() + told[1:-1])
        assert re.search(rf" {name}(=\S+)? {said} ", helped), name


def test_environment_does_not_reach_the_reference(monkeypatch):
    monkeypatch.setenv("CPAS_DATA", "/home/somebody")
    assert "somebody" not in PARTS["options"]()


def mentioning():
    """Every file in which somebody reads of an option."""
    patterns = ("*.md", "*.py", "docs/**/*.md", "pytest_cpas/**/*.py", "method_adapters/**/*.py")
    files = [path for pattern in patterns for path in ROOT.glob(pattern)]
    return [*files, *ROOT.glob("pytest_cpas/adapter_template/*"), *ROOT.glob("tools/**/*.py")]


def test_no_option_is_mentioned_that_does_not_exist(defaults):
    known = {*map(option, defaults)}
    for path in mentioning():
        for name in re.findall(r"--cpas-[a-z]+(?:-[a-z]+)*", path.read_text(encoding="utf-8")):
            assert name in known, f"{path.relative_to(ROOT)} mentions {name}"


def subcommands(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    return set(re.search(r"\{(.+?)\}", capsys.readouterr().out)[1].split(","))


def test_subcommands_exist_and_are_in_the_reference(capsys):
    known = subcommands(capsys)
    page = text("reference/options.md")
    assert set(re.findall(r"^### pytest-cpas (\S+)", page, re.MULTILINE)) == known
    for name in known:
        with pytest.raises(SystemExit):
            main([name, "--help"])
        options = re.findall(r"^  (?:-\w, )?(--[a-z-]+)", capsys.readouterr().out, re.MULTILINE)
        told = section(page, name)
        assert all(f"`{each}" in told for each in options if each != "--help")
    for where, markdown in [("README.md", README), *((name, text(name)) for name in pages())]:
        for name in re.findall(r"\bpytest-cpas ([a-z][a-z-]+)", "\n".join(code(markdown))):
            assert name in known, f"{where} mentions pytest-cpas {name}"


def test_readme_has_every_option(defaults):
    table = README.partition("| option | what it does |")[2].partition("\n\n")[0]
    told = set(re.findall(r"--cpas-[a-z-]+", table))
    assert {*map(option, defaults)} - told == set()


def test_every_metric_is_in_the_reference():
    page = text("reference/metrics.md")
    described = anchors(page)
    assert {f"pytest_cpas.metrics.{name}" for name in metrics.__all__} <= described
    for name in metrics.__all__:
        assert len(section(page, f"pytest_cpas.metrics.{name}").strip()) > 20, name
    for entry in DEFINITIONS.values():
        assert f"`{entry.name}:{entry.variant}:{entry.version}" in page


def test_every_definition_is_explained():
    overview = text("metrics.md").partition("## Overview")[2].partition("\n## ")[0]
    told = set(re.findall(r"`(\w+:[\w-]+)`", overview))
    assert told == {":".join(key) for key in DEFINITIONS}


def test_every_check_is_in_the_reference():
    page = text("reference/checks.md")
    contract = {cell.partition("]")[0].strip("[`") for cell in column(page, "check")}
    assert contract == set(CONTRACT)
    for check in CONTRACT.values():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| [`{check.name}`]")]
        assert ("| yes |" in row) == check.smoke
        assert check.statement in row
    for name in CHECKS:
        assert f"| `{name}` |" in page
    for name, prop in PROPERTIES.items():
        metric, _, rest = name.partition(".")
        assert f"| `{rest}` |" in section(page, f"properties-{metric}"), name
        assert " ".join(prop.statement.split()).replace("|", "&#124;") in page, name


def test_properties_can_be_read_in_the_repository():
    made = make_properties.page_text()
    assert make_properties.PATH.read_text(encoding="utf-8") == made, "run tools/make_properties.py"


@pytest.mark.parametrize(
    ("check", "made", "demanded"),
    [
        ("answers", "always", "always"),
        ("background", "always", "never"),
        ("colour", "if `needs` lacks `rgb`", "if `deterministic`"),
        ("no_evidence", "if `needs` has `depth`", "if `deterministic` and `needs` has `depth`"),
        ("shape_in_box", "if `gives` has `extents` and `gives` has `shape`", "always"),
        ("mirror", "always", "if `deterministic` and `equivariances` has `mirror`"),
    ],
)
def test_when_a_check_is_demanded(check, made, demanded):
    page = text("reference/checks.md")
    (row,) = [line for line in page.splitlines() if line.startswith(f"| [`{check}`]")]
    assert row.endswith(f"| {made} | {demanded} |")


def test_the_written_lists_of_checks_are_complete():
    contract = column(text("method-contract.md"), "check")
    named = {name: "*" in cell for cell in contract for name in re.findall(r"`(\w+)`", cell)}
    assert named == {name: check.smoke for name, check in CONTRACT.items()}
    assert [cell.strip("`") for cell in column(text("dataset-checks.md"), "check")] == list(CHECKS)
    conformance = text("metric-conformance.md")
    offered = re.findall(r"`(\w+)`", " ".join(column(conformance, "metric")))
    assert offered == list(KNOWN)
    assert f"against {len(PROPERTIES)} properties" in conformance


@pytest.mark.parametrize("name", ["reference/api.md", "reference/metrics.md"])
def test_signatures_are_python(name):
    calls = [body for body in blocks(text(name), "python") if re.match(r"\w+\(", body)]
    assert len(calls) > 15
    for call in calls:
        ast.parse(f"def {call.strip()}: ...")


@pytest.mark.parametrize("kind", ["methods", "datasets", "metrics"])
def test_everything_registered_is_in_the_reference(kind):
    names = importlib.metadata.entry_points(group=f"pytest_cpas.{kind}").names
    page = text("reference/registered.md")
    prefix = {"methods": "method-", "datasets": "dataset-", "metrics": ""}[kind]
    for name in names:
        assert f"| `{name}` |" in page if kind == "metrics" else prefix + name in anchors(page)
    if kind == "datasets":
        cells = " ".join(column(text("datasets.md"), "name"))
        assert {name.partition(":")[0] for name in re.findall(r"`([^`]+)`", cells)} == names


def test_verdicts():
    page = text("reference/verdicts.md")
    assert column(page, "verdict") == [word.value for word in Word]
    assert column(page, "verdict on speed") == [word.value for word in SpeedWord]
    assert column(page, "verdict on parity") == [word.value for word in ParityWord]
    for words in (DatasetWord, Outcome):
        assert all(f"| {word.value} |" in page for word in words)
    page = page.partition("## On the speed")[0]
    rows = re.findall(r"^\| ([A-Z ]+) \| .* \| (\d) \| (\d) \| (\d) \|$", page, re.MULTILINE)
    codes = {word: plain for word, plain, _, _ in rows}
    plain, required, strict = ({row[0] for row in rows if row[i] == "0"} for i in (1, 2, 3))
    assert plain - required == {"NOT CHECKED"}
    assert required - strict == {"PROBABLY WORSE"}
    good = {"MATCHES", "AGREES WITH THE PAPER", "ABOVE THE PAPER", "RECORDED", "CANNOT TELL"}
    assert strict == good | {"OUTDATED", "BORDERLINE"}
    # the README's table is written by hand
    told = README.partition("| verdict | meaning | exit code |\n|---|---|---|\n")[2]
    for row in told.partition("\n\n")[0].splitlines():
        words, _, number = (cell.strip() for cell in row.strip("|").split("|"))
        assert {codes[word] for word in words.split(", ")} == {number[0]}, row
    known = {word for row in column(README, "verdict") for word in row.split(", ")}
    assert known == set(codes) - {"RECORDED", "NOT RECORDED"}


def test_exit_codes():
    told = dict(zip(column(text("reference/verdicts.md"), "exit code"), range(9), strict=False))
    assert list(told) == [f"`{int(each)}`" for each in pytest.ExitCode]


def test_the_schema_is_described():
    schema = json.loads((ROOT / "pytest_cpas/report/schema.json").read_text(encoding="utf-8"))
    page = text("reference/formats.md")

    def descriptions(value):
        if isinstance(value, dict):
            yield from [value["description"]] if isinstance(value.get("description"), str) else []
            value = list(value.values())
        for each in value if isinstance(value, list) else []:
            yield from descriptions(each)

    for told in descriptions(schema):
        assert told in page
    for name in schema["properties"]:
        assert f"| `{name}` |" in page


def test_every_generated_part_is_on_a_page():
    markers = [re.findall(r"^<!-- reference: (\S+)", (DOCS / p).read_text(), re.M) for p in pages()]
    assert {name for found in markers for name in found} == set(PARTS)


def test_a_marker_that_names_nothing_is_an_error():
    from reference import expand

    with pytest.raises(KeyError, match="opions"):
        expand("<!-- reference: opions -->")


@pytest.mark.parametrize("name", pages())
def test_nothing_generated_looks_unfinished(name):
    """No Sphinx roles, no addresses of objects, no paths of the machine, balanced fences."""
    page = text(name)
    assert not re.search(r":(class|func|meth|data|mod|attr):`", page)
    assert not re.search(r" at 0x[0-9a-f]{6,}", page)
    assert str(ROOT) not in page
    assert page.count("\n```") % 2 == 0


def target_anchors(path):
    if path.suffix != ".md":
        return set()
    if path.is_relative_to(DOCS):
        return anchors(text(path.relative_to(DOCS).as_posix()))
    return anchors(path.read_text(encoding="utf-8"), github=True)


@pytest.mark.parametrize("name", ["../README.md", *pages()])
def test_links_resolve(name):
    here = (DOCS / name).resolve()
    markdown = README if here == ROOT / "README.md" else text(name)
    for link in links(markdown):
        if re.match(r"\w+:", link):
            continue
        file, _, anchor = link.partition("#")
        if file in MADE:
            continue
        target = (here.parent / file).resolve() if file else here
        assert target.exists(), f"{name}: {link}"
        if here != ROOT / "README.md":
            assert target.is_relative_to(DOCS), f"{name}: {link} is not part of the site"
        assert not anchor or anchor in target_anchors(target), f"{name}: {link}"


@pytest.mark.parametrize("name", ["../README.md", *pages()])
def test_names_in_code_exist(name):
    """Modules and what is in them, and files of the repository."""
    everything = "\n".join(code((DOCS / name).read_text(encoding="utf-8")))
    for dotted in set(re.findall(r"\bpytest_cpas(?:\.\w+)+", everything)) - MOVED.keys():
        if not dotted.endswith((".toml", ".md", ".methods", ".datasets", ".metrics")):
            pkgutil.resolve_name(dotted)
    folders = "benchmarks|docs|golden|method_adapters|pytest_cpas|tests|tools"
    for path in set(re.findall(rf"(?<![\w/.-])(?:{folders})/[\w./*-]*\w", everything)):
        assert [*ROOT.glob(path)] or path.startswith("golden/recorded/my-method"), path


def nav_files(entry):
    if isinstance(entry, str):
        return [entry]
    values = entry.values() if isinstance(entry, dict) else entry
    return [file for value in values for file in nav_files(value)]


def test_every_page_is_in_the_navigation():
    yaml = pytest.importorskip("yaml")
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = [name for name in nav_files(config["nav"]) if name not in MADE]
    assert sorted(listed) == pages()
    assert set(config["validation"]["nav"].values()) == {"warn"}
    assert set(config["validation"]["links"].values()) == {"warn"}


@pytest.mark.parametrize("name", ["../README.md", *pages()])
def test_code_parses(name):
    markdown = (DOCS / name).read_text(encoding="utf-8")
    for body in blocks(markdown, "toml"):
        tomllib.loads(body)
    for body in blocks(markdown, "json"):
        json.loads(body)
    for body in blocks(markdown, "python"):
        if not re.search(r"^ *for \.\.\.$", body, re.MULTILINE):  # which says: something like it
            compile(body, name, "exec")
    for body in blocks(markdown, "yaml"):
        yaml = pytest.importorskip("yaml")
        assert isinstance(yaml.safe_load(body), dict)


def test_pages_are_plain_files():
    """What Python-Markdown needs that GitHub does not: an empty line before a list."""
    for name in pages():
        lines = text(name).splitlines()
        fenced = False
        for before, line in itertools.pairwise(lines):
            fenced ^= before.startswith("```")
            if not fenced and re.match(r"([*-]|\d+\.) ", line):
                assert not before or re.match(r"([*-]|\d+\.) | ", before), f"{name}: {line}"


def test_a_page_that_fetches_something_ends_the_build():
    pytest.importorskip("mkdocs")
    from docs_hook import on_post_page
    from mkdocs.exceptions import PluginError

    local = '<a href="https://example.org"><script src="bundle.js"></script>'
    assert on_post_page(local, "page") == local
    for fetched in (
        '<script src="https://unpkg.com/iframe-worker/shim"></script>',
        '<link rel="stylesheet" href="https://fonts.googleapis.com/css?family=Roboto">',
        '<img alt="" src="http://example.org/a.png">',
    ):
        with pytest.raises(PluginError, match="without network"):
            on_post_page(local + fetched, "page")
