"""The commands say what they take, fast, and turn mistakes into one line."""

import contextlib
import io
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from unittest.mock import patch

import pytest

import lab.cli
import streetgen.cli
from cav_agent.config import AgentConfig
from mec_server.config import ServerConfig
from rfcore.program import parse_options
from rfedge.cli import main

GROUPS = ("field", "dataset", "eval", "certs")
SAMPLES = Path(__file__).parents[2] / "samples"
FIELD = str(SAMPLES / "fields/street.rff")
TRAIN_VIEWS = str(SAMPLES / "street/transforms_train.json")
HEAVY = ("numpy", "torch", "cv2", "matplotlib", "av", "grpc", "cryptography")


@dataclass(frozen=True)
class Ended:
    returncode: int
    stdout: str
    stderr: str


def rfedge(*arguments: str) -> Ended:
    """Run the command in this process: a start costs more than most of what is tested here."""
    out, err = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, "argv", ["rfedge", *arguments]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            code = main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return Ended(code, out.getvalue(), err.getvalue())


def in_a_process(*arguments: str) -> Ended:
    command = [sys.executable, "-m", "rfedge", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return Ended(done.returncode, done.stdout, done.stderr)


@cache
def help_of(verb: str) -> str:
    done = rfedge(*verb.split(), "--help")
    assert done.returncode == 0, done.stderr
    return done.stdout


def in_one_line(text: str) -> str:
    return " ".join(text.replace("│", " ").split())


def verbs_in(text: str) -> list[str]:
    listed = re.search(r"\{([a-z,-]+)\}", text)
    return listed[1].split(",")


def test_every_verb_has_help_that_says_once_what_it_does():
    verbs = verbs_in(help_of(""))
    assert set(GROUPS) < set(verbs)
    verbs += [f"{group} {verb}" for group in GROUPS for verb in verbs_in(help_of(group))]
    for verb in verbs:
        text = in_one_line(help_of(verb))
        assert text.count(in_one_line(help_of(verb).split("\n\n")[1])) == 1, verb
        assert "{None}" not in text, verb
        assert "(default: True)" not in text, f"{verb}: a flag does the opposite of its text"


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (AgentConfig, "cav-agent"),
        (ServerConfig, "mec-server"),
        (lab.cli.Verb, "rfedge-lab scale"),
        (streetgen.cli.Verb, "streetgen build"),
    ],
)
def test_every_program_wraps_its_help_by_the_width_alone(kind, name, monkeypatch):
    """No line of an option's text has room for the first word of the next."""
    monkeypatch.setenv("COLUMNS", "100")
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit):
        parse_options(kind, name, [*name.split()[1:], "--help"])
    page = out.getvalue()
    lines = [line[2:-2] for line in page.splitlines() if line.startswith("  ")]
    indents = [len(line) - len(line.lstrip()) for line in lines]
    room = [len(line) - len(line.rstrip()) for line in lines]
    wrapped = [k for k in range(1, len(lines)) if indents[k] == indents[k - 1] > 5]
    assert len(wrapped) > 3
    assert all(len(lines[k].split()[0]) >= room[k - 1] for k in wrapped), page
    assert "(default: True)" not in page


@pytest.mark.parametrize(
    ("verb", "shown"),
    [
        ("train", "DATASET"),
        ("train", "--held-out DATASET"),
        ("train", "--size WIDTHxHEIGHT"),
        ("encode", "--field FIELD"),
        ("encode", "--out FILE.rfv"),
        ("render", "FIELD"),
        ("dataset poses", "--register-to DATASET"),
        ("watch", "HOST:PORT"),
        ("link", "--to HOST:PORT"),
        ("field info", "FIELD"),
        ("eval compare", "FIELD"),
    ],
)
def test_placeholders_say_what_they_want(verb, shown):
    assert f" {shown} " in in_one_line(help_of(verb))


def test_the_help_of_an_option_is_one_paragraph(monkeypatch):
    """Where its docstring goes on in a second line, the terminal's width decides alone."""
    monkeypatch.setenv("COLUMNS", "500")
    done = rfedge("train", "--help")
    assert "KITTI, ...). Of a folder that `rfedge dataset split` made" in done.stdout


@pytest.mark.parametrize("words", ["nonsense --help", "eval paper -h", "field nonsense --help"])
def test_help_of_a_verb_that_there_is_not_is_an_error(words):
    done = rfedge(*words.split())
    assert done.returncode == 2
    assert words.split()[-2] in done.stderr


def test_the_version_is_that_of_the_distribution():
    done = in_a_process("--version")
    assert (done.returncode, done.stdout) == (0, f"rfedge {version('rfedge')}\n")


def test_the_help_loads_nothing_heavy():
    """Imports make ``--help`` slow (torch alone takes seconds), so they are looked for."""
    code = (
        f"import sys; import rfedge.cli; print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("render", "missing.rff", "--drive", "d", "--out", "o"), "missing.rff"),
        (("train", "nowhere", "--out", "field.rff"), "nowhere"),
        (("train", "nowhere", "--out", "field.txt"), "must end in .rff"),
        (("demo", "--sample", "nowhere"), "nowhere"),
        (("demo", "--link-bps", "0"), "above 0 bit/s"),
        (("decode", "missing.rfv", "--field", "f.rff", "--out", "o"), "missing.rfv"),
        (("localise", "nowhere", "--field", FIELD), "nowhere"),
        (("localise", TRAIN_VIEWS, "--field", FIELD, "--start-error", "2m"), "METRESm:DEGREESdeg"),
        (("localise", TRAIN_VIEWS, "--field", FIELD, "--tries", "0"), "0 tries"),
        (("link", "--to", "nonsense"), "nonsense"),
        (("link", "--to", "127.0.0.1:1", "--profile", "missing.toml"), "missing.toml"),
        (("loadtest", "--hz", "0"), "0.1..1000 Hz"),
        (("loadtest", "--live", "--mode", "receiver"), "live vehicles need mode full"),
        (("loadtest", "--field", "missing.rff"), "missing.rff"),
        (("watch", "nonsense"), "nonsense"),
        (("watch", "127.0.0.1:1", "--tls-cert", "c.pem"), "belong together"),
        (("certs", "show", "nowhere"), "nowhere"),
        (("certs", "init", "--vehicles", "a/b"), "'a/b' must be"),
        (("eval", "compare", FIELD, "drive.json"), "NAME@HZ=DATASET"),
        (("eval", "ladder", "nowhere"), "'nowhere' is no field"),
        (("train", TRAIN_VIEWS, "--out", "f.rff", "--report", "r.html"), "add --holdout 8"),
        (("dataset", "convert", "nowhere", "--out", "o"), "nowhere"),
        (("dataset", "convert", "nowhere", "--out", "o", "--size", "big"), "'big' is not WIDTHx"),
        (("dataset", "poses", "nowhere", "--out", "o"), "nowhere: holds no pictures"),
        (("dataset", "record-carla", "--out", "o", "--cameras", "top"), "'top' is none of"),
        (
            ("dataset", "record-carla", "--out", "o", "--port", "1", "--timeout-s", "1"),
            "127.0.0.1:1",
        ),
    ],
)
def test_a_users_mistake_is_one_line_and_exit_status_2(arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = rfedge(*arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert list(tmp_path.iterdir()) == [], "a refused command leaves nothing behind"


def test_a_process_ends_with_that_line_and_status():
    done = in_a_process("train", "nowhere", "--out", "field.txt")
    assert done == rfedge("train", "nowhere", "--out", "field.txt")
    assert done.returncode == 2


def test_a_reader_that_has_enough_ends_the_command_quietly():
    command = [sys.executable, "-m", "rfedge", "eval", "--help"]
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as nobody:
        done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, check=False)
    assert (done.returncode, done.stderr) == (141, b"")


def test_a_log_file_gets_each_line_as_it_comes(tmp_path):
    """The first line of a long training arrives in a pipe while it goes on."""
    code = "import sys; from rfedge.cli import main; sys.exit(main())"
    street = Path(__file__).parents[2] / "samples/street/transforms_train.json"
    options = f"--iterations 1000000 --gaussians 500 --out {tmp_path / 'field.rff'}"
    training = subprocess.Popen(
        [sys.executable, "-c", code, "train", str(street), *options.split()],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert training.stdout.readline().startswith("Training 500 Gaussians")
        assert training.poll() is None
    finally:
        training.kill()
        training.communicate()
