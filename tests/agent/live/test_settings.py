"""Addresses of live cameras, and what FFmpeg is told."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cav_agent.config import AgentConfig, PaceKind
from cav_agent.live.settings import (
    LiveSettings,
    ReaderSettings,
    RtspTransport,
    SourceKind,
    parse_address,
    without_password,
)
from rfcore.errors import InvalidInput

SIZE_PX = (640, 360)
CAMERA = Path("camera.toml")


@pytest.mark.parametrize(
    ("text", "kind", "url", "demuxer"),
    [
        ("/dev/video0", SourceKind.V4L2, "/dev/video0", "v4l2"),
        ("v4l2:/dev/v4l/by-id/cam", SourceKind.V4L2, "/dev/v4l/by-id/cam", "v4l2"),
        ("rtsp://u:p@cam:554/a?b=c", SourceKind.RTSP, "rtsp://u:p@cam:554/a?b=c", None),
        ("rtsps://cam/a", SourceKind.RTSP, "rtsps://cam/a", None),
        ("rtp://239.0.0.1:5004", SourceKind.RTP, "rtp://239.0.0.1:5004", None),
        ("udp://[::]:5004", SourceKind.MPEG_TS, "udp://[::]:5004", "mpegts"),
        ("cameras/front.SDP", SourceKind.SDP, "cameras/front.SDP", "sdp"),
        ("drive.mp4", SourceKind.FILE, "drive.mp4", None),
        ("/data/a:b.mkv", SourceKind.FILE, "/data/a:b.mkv", None),
    ],
)
def test_an_address_says_what_is_opened(
    text: str, kind: SourceKind, url: str, demuxer: str | None
) -> None:
    address = parse_address(text)
    assert (address.kind, address.url, address.format) == (kind, url, demuxer)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is none of"),
        ("http://cam/a.mjpg", "is none of"),
        ("concat://a", "is none of"),
        ("rtp://host", "does not name HOST:PORT"),
        ("rtsp:///path", "does not name a host"),
        ("udp://host:99999", "out of range"),
        ("v4l2:video0", "names no device"),
        ("a\0b.mp4", "is none of"),
    ],
)
def test_what_is_no_camera_is_refused(text: str, says: str) -> None:
    with pytest.raises(InvalidInput, match=says) as caught:
        parse_address(text)
    assert caught.value.args[0].startswith("source")


@pytest.mark.parametrize(
    "kind", [kind for kind in SourceKind if kind not in (SourceKind.V4L2, SourceKind.BAG)]
)
def test_a_source_opens_no_protocol_but_its_own(kind: SourceKind) -> None:
    texts = {SourceKind.SDP: "a.sdp", SourceKind.FILE: "a.mp4"}
    address = parse_address(texts.get(kind, f"{kind}://127.0.0.1:5004"))
    allowed = address.options["protocol_whitelist"].split(",")
    assert not {"http", "https", "pipe", "concat", "subfile"} & set(allowed)
    assert ("file" in allowed) == (kind in texts)


def test_no_password_is_logged() -> None:
    assert without_password("rtsp://me:secret@cam:554/a?key=secret") == "rtsp://cam:554/a"
    with pytest.raises(InvalidInput) as caught:
        parse_address("rtmp://me:secret@cam/a")
    assert "secret" not in str(caught.value)


def test_a_v4l2_device_is_asked_for_size_rate_and_format() -> None:
    settings = LiveSettings("/dev/video2", CAMERA)
    assert settings.opened_for(SIZE_PX).options == {"video_size": "640x360"}
    settings = replace(settings, v4l2_size="1280x720", v4l2_rate=29.97, v4l2_format="mjpeg")
    assert settings.opened_for(SIZE_PX).options == {
        "video_size": "1280x720",
        "framerate": "29.97",
        "input_format": "mjpeg",
    }


def test_rtsp_comes_by_tcp_unless_asked_otherwise() -> None:
    settings = LiveSettings("rtsp://cam/a", CAMERA)
    assert settings.opened_for(SIZE_PX).options["rtsp_transport"] == "tcp"
    settings = replace(settings, rtsp_transport=RtspTransport.UDP)
    assert settings.opened_for(SIZE_PX).options["rtsp_transport"] == "udp"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"camera_file": None}, "camera_file: is missing"),
        ({"source": "ftp://a"}, "source: 'ftp://a' is none of"),
        ({"source_timeout_s": 0.0}, "source_timeout_s: 0.0 s is outside"),
        ({"v4l2_size": "640"}, "v4l2_size: '640' is not WIDTHxHEIGHT"),
        ({"v4l2_format": "x:y"}, "v4l2_format: 'x:y' is no name"),
        ({"v4l2_rate": float("nan")}, "v4l2_rate: nan Hz is outside"),
    ],
)
def test_a_bad_option_is_refused_by_name(change: dict[str, Any], says: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        replace(LiveSettings("a.mp4", CAMERA), **change)
    assert str(caught.value).startswith(says)


def test_the_reader_is_told_all_of_it() -> None:
    told = ReaderSettings(parse_address("rtsp://cam/a"), 2.5, 10.0)
    assert ReaderSettings.of_json(told.to_json()) == told


def test_an_agent_has_one_kind_of_pictures() -> None:
    live = LiveSettings("a.mp4", CAMERA)
    assert AgentConfig("127.0.0.1:1", live=live).drive is None
    drive, rig = Path("drive"), Path("rig.toml")
    for wrong in ({"drive": None}, {"drive": drive, "live": live}, {"drive": drive, "rig": rig}):
        with pytest.raises(InvalidInput, match="exactly one of --drive, --source and --rig"):
            AgentConfig("127.0.0.1:1", **wrong)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="a live camera does not wait"):
        AgentConfig("127.0.0.1:1", live=live, pace=PaceKind.LOCKSTEP)
