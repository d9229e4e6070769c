"""Options of a service from a TOML file, with the command line's in front of them."""

import pytest

from cav_agent.config import AgentConfig
from mec_server.config import ServerConfig
from rfcore.errors import InvalidInput
from rfcore.program import parse_options
from rfcore.wire.settings import words_of_command_line


@pytest.fixture
def parsed(tmp_path):
    def parse(made, text, *words):
        file = tmp_path / "service.toml"
        file.write_text(text)
        given = words_of_command_line([*words, "--config", str(file)])
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


def test_an_unknown_key_and_a_missing_file_end_the_command(parsed, capsys):
    with pytest.raises(SystemExit):
        parsed(AgentConfig, 'server = "a:1"\ndrive = "d"\nwheels = 4\n')
    assert "--wheels" in "".join(capsys.readouterr())
    with pytest.raises(InvalidInput, match=r"nowhere\.toml"):
        words_of_command_line(["--config=nowhere.toml"])


def test_without_a_file_the_words_stay_as_they_are():
    assert words_of_command_line(["--rate", "2", "--loop"]) == ["--rate", "2", "--loop"]
