"""Links of the documentation lead somewhere, and the commands in it are commands."""

import importlib
import re
from itertools import pairwise
from pathlib import Path

import pytest

import rfedge.cli
from docs.pages import DOCS, PROGRAMS, ROOT, Page, commands
from lab.pages.metrics import families
from rfedge.results import read_result, rows_of
from scripts import loaded

build_site = loaded("docs/build_site.py")
PAGES = sorted(DOCS.rglob("*.md"))
OTHERS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
WRITTEN = [page for page in PAGES if page.parent != DOCS] + OTHERS
ids = [str(page.relative_to(ROOT)) for page in WRITTEN]


def prose_and_blocks(page: Path) -> tuple[str, list[str]]:
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?!layers)\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), blocks


@pytest.mark.parametrize("page", WRITTEN, ids=ids)
def test_links_lead_to_files_and_generated_pages(page):
    prose, _ = prose_and_blocks(page)
    generated = {DOCS / "reference" / name for name in build_site.reference_names()}
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", prose):
        if not re.match(r"https?:", target):
            file = (page.parent / target).resolve()
            assert file.exists() or file in generated, target


BLOCKS = [block for page in WRITTEN for block in prose_and_blocks(page)[1]]
LINES = sorted({tuple(words) for block in BLOCKS for words in commands(block)})


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of real ones: the services read them when they parse."""
    folder = tmp_path_factory.mktemp("made") / "certs"
    rfedge.cli.parse(["certs", "init", "--out", str(folder)]).run()
    return folder


@pytest.mark.parametrize("words", LINES, ids=" ".join)
def test_every_command_is_one(words, certificates, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = list(words)
    for place, (option, value) in enumerate(pairwise(words), 1):
        if option == "--fields":
            Path(value).mkdir(parents=True)
        elif option.startswith("--tls-"):
            given[place] = str(certificates / Path(value).name)
    assert build_site.PROGRAMS[words[0]](given[1:]) is not None


@pytest.mark.parametrize("page", WRITTEN, ids=ids)
def test_options_named_in_prose_exist(page):
    prose, _ = prose_and_blocks(page)
    for span in re.findall(r"`([^`]+)`", prose):
        program = span.split(" ")[0]
        if program in PROGRAMS and "--tyro" not in span:
            known = build_site.option_names(program)
            assert set(re.findall(r"--[a-z][a-z0-9-]*", span)) <= known, span


SPANS = {
    str(page.relative_to(ROOT)): re.findall(r"`([^`\n]+)`", prose_and_blocks(page)[0])
    for page in WRITTEN
}
SOURCES = ("rfcore", "cav_agent", "mec_server", "rfedge", "streetgen", "lab")
FOLDERS = (*SOURCES, "tests", "deploy", "docs", "examples", "samples", "proto", "requirements")


@pytest.mark.parametrize("spans", SPANS.values(), ids=SPANS)
def test_files_named_in_prose_exist(spans):
    for span in spans:
        if re.fullmatch(rf"(?:{'|'.join(FOLDERS)})/[\w./-]*", span) and "NAME" not in span:
            assert (ROOT / span).exists(), span


@pytest.mark.parametrize("spans", SPANS.values(), ids=SPANS)
def test_python_names_in_prose_exist(spans):
    for span in spans:
        name = re.match(rf"(?:{'|'.join(SOURCES)})(?:\.\w+)+(?::[\w.]+)?(?=\(|$)", span)
        subject_of_nats = re.search(r"\.(VEHICLE|ENCODING)\b", span)
        if name is not None and not subject_of_nats:
            assert resolved(name[0].replace(":", ".")) is not None, span


def resolved(name: str) -> object:
    """Import the longest module that a dotted name begins with; return the attribute."""
    words = name.split(".")
    for count in range(len(words), 0, -1):
        try:
            found: object = importlib.import_module(".".join(words[:count]))
        except ModuleNotFoundError:
            continue
        for attribute in words[count:]:
            found = getattr(found, attribute)
        return found
    raise AssertionError(name)


def test_tests_named_in_prose_exist():
    sources = "".join(path.read_text(encoding="utf-8") for path in ROOT.glob("tests/**/*.py"))
    defined = set(re.findall(r"def (test_\w+)", sources))
    named = {span for spans in SPANS.values() for span in spans if span.startswith("test_")}
    assert named - defined == set()
    assert named, "explanation/method.md names tests"


def test_programs_have_their_page_with_every_verb():
    pages = build_site.command_pages()
    assert set(pages) == {f"commands/{name}.md" for name in PROGRAMS}
    for verb in ("train", "field publish", "eval compare"):
        assert f"## rfedge {verb}\n" in pages["commands/rfedge.md"]
    assert "| `--drain-hold-s FLOAT` |" in pages["commands/mec-server.md"]


def test_every_metric_and_message_is_in_the_reference():
    for declared in families().values():
        for family in declared:
            assert f"`{family.name}`" in build_site.metrics_page()
    assert "message Hello {" in build_site.protocol_page()


@pytest.mark.parametrize("place", build_site.ROWS)
def test_a_list_of_rows_in_recorded_results_is_read_as_the_reference_says(place):
    kind, key = place.split()
    results = [read_result(path) for path in build_site.RESULTS.glob("*.json")]
    found = [result[key] for result in results if result["kind"] == kind and result.get(key)]
    assert found
    for rows in found:
        assert rows_of(build_site.row_type(build_site.ROWS[place]), rows)


def test_the_site_has_every_page_of_its_contents(tmp_path):
    build_site.collect(tmp_path / "site")
    contents = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = set(re.findall(r"[\w/-]+\.md", contents.partition("nav:")[2]))
    assert {name for name in named if not (tmp_path / "site" / name).is_file()} == set()
    assert len(named) > len(PROGRAMS)


def test_the_tutorials_are_pages():
    tutorials = [page for page in PAGES if page.parent.name == "tutorials"]
    assert all(Page(str(page.relative_to(DOCS))).blocks("sh") for page in tutorials)
