"""The rules are valid, tested by promtool, and ask only for metrics that exist."""

import re
import subprocess
from pathlib import Path

import pytest

from lab.pages.metrics import families

DEPLOY = Path(__file__).parents[2] / "deploy/prometheus"
RULES = (DEPLOY / "rules.yml").read_text()
TESTS = "".join(path.read_text() for path in sorted((DEPLOY / "tests").glob("*.yml")))
DECLARED = {family.name: family for listed in families().values() for family in listed}


def passes(*command: str) -> None:
    done = subprocess.run(command, cwd=DEPLOY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.prometheus
def test_promtool_accepts_rules_and_configuration(promtool):
    passes(promtool, "check", "rules", "rules.yml")
    passes(promtool, "check", "config", "prometheus.yml")


@pytest.mark.slow
@pytest.mark.prometheus
def test_promtool_finds_that_the_rules_do_what_they_say(promtool):
    passes(promtool, "test", "rules", "tests/recording.yml", "tests/alerts.yml")


def test_the_rules_ask_only_for_metrics_that_exist():
    asked = set(re.findall(r"(?<![\w:])((?:rfedge|process)_\w+)(?!\w*:)", RULES))
    known = set(DECLARED)
    for family in DECLARED.values():
        if family.kind == "histogram":
            known |= {f"{family.name}_{part}" for part in ("bucket", "count", "sum")}
    assert asked - known == set()


@pytest.mark.parametrize("name", re.findall(r"- (?:record|alert): (\S+)", RULES))
def test_every_rule_has_a_test(name):
    assert name in TESTS
