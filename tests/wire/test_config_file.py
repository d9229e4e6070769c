"""Options of a service from a TOML file, with the command line's in front of them."""

import re

import pytest

from cav_agent.config import AgentConfig
from mec_server.config import ServerConfig
from rfcore.errors import InvalidInput
from rfcore.program import option_names, parse_options
from rfcore.wire.settings import words_of_command_line


@pytest.fixture
def parsed(tmp_path):
    def parse(made, text, *words):
        file = tmp_path / "service.toml"
        file.write_text(text)
        given = words_of_command_line([*words, "--config", str(file)], option_names(made))
        return parse_options(made, "service", given)

    return parse


def test_a_file_stands_for_the_options_and_the_command_line_wins(parsed, tmp_path):
    text = 'server = "a:1"\ndrive = "d"\nrate = 5\nloop = true\nneighbours = ["b:2", "c:3"]\n'
    text += "metrics_port = 9000\nallow_recording = false\n"
    config = parsed(AgentConfig, text, "--rate", "2.5")
    assert (config.server, config.rate, config.loop) == ("a:1", 2.5, True)
    assert config.neighbours == ("b:2", "c:3")
    assert (config.metrics.port, config.allow_recording) == (9000, False)
    server = parsed(ServerConfig, f'fields = "{tmp_path}"\nno-notices = true\n')
    assert server.no_notices


@pytest.mark.parametrize(
    "text", ["[table]\nx = 1\n", "rate = []\n", "rate = \n", "x = [{a = 1}]\n"]
)
def test_what_is_no_option_is_refused_with_the_file(parsed, text):
    with pytest.raises(InvalidInput, match=r"service\.toml"):
        parsed(AgentConfig, text)


@pytest.mark.parametrize(
    ("made", "key", "nearest"),
    [(AgentConfig, "feilds", "fields"), (ServerConfig, "metric_port", "metrics-port")],
)
def test_an_unknown_key_is_named_with_its_file_and_the_nearest_there_is(parsed, made, key, nearest):
    with pytest.raises(InvalidInput, match=rf"service\.toml: {key}: .*nearest key is {nearest}$"):
        parsed(made, f"{key} = 4\n")
    with pytest.raises(InvalidInput, match=r"service\.toml: wheels: is no option; keys are"):
        parsed(made, "wheels = 4\n")


def test_a_missing_file_ends_the_command():
    with pytest.raises(InvalidInput, match=r"nowhere\.toml"):
        words_of_command_line(["--config=nowhere.toml"], ())


@pytest.mark.parametrize("made", [AgentConfig, ServerConfig])
def test_the_names_of_options_hold_those_of_the_help(made, capsys):
    with pytest.raises(SystemExit):
        parse_options(made, "service", ["--help"])
    helped = set(re.findall(r"(?m)^\W*--([a-z][a-z0-9-]+)(?: |$)", capsys.readouterr().out))
    assert "tls-cert" in helped
    assert helped - {"help"} <= set(option_names(made)), "and those that help does not show"


def test_without_a_file_the_words_stay_as_they_are():
    assert words_of_command_line(["--rate", "2", "--loop"], ()) == ["--rate", "2", "--loop"]
