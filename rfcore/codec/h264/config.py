"""A stream's configuration, and the H.264 level its size needs.

How much a coder tries is its *effort*, one name for both coders: ``fast``, ``default`` and
``thorough`` are those of our slice coder, ``x264-medium`` and its like are x264's presets. A stream
keeps its coder, because the two write different parameter sets; any frame may have another effort.

Options are checked here against closed lists, because x264 ignores an option it does not know;
``rfcore.codec.h264.bitstream`` checks afterwards that the encoder did what it was asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from rfcore.errors import InvalidInput

PRESETS = (
    "ultrafast",
    "superfast",
    "veryfast",
    "faster",
    "fast",
    "medium",
    "slow",
    "slower",
    "veryslow",
)
"""x264's presets, but not placebo, which costs several times veryslow and gains nothing."""

OWN_EFFORTS = ("fast", "default", "thorough")
DEFAULT_EFFORT = "default"
_X264 = "x264-"
EFFORTS = (*OWN_EFFORTS, *(f"{_X264}{preset}" for preset in PRESETS))
"""The efforts of both coders."""

CRF_RANGE = (1.0, 51.0)
"""Below a CRF of 1, x264 leaves High profile for lossless High 4:4:4 with other parameter sets."""

MIN_SIDE_PX = 2
MAX_SIDE_PX = 8192
MAX_MACROBLOCKS = 36_864
"""The largest picture of level 5.2: 4096x2304, or another shape of no more macroblocks."""

PICTURES_PER_SECOND = 50
"""The rate that levels are chosen for: 25 frames, each with the I_PCM picture it predicts from."""

REFERENCE_FRAMES = 4
"""Most references of one frame. It is fixed for a stream, so that its parameter sets serve any
number up to it; streams of x264 have ``X264_REFERENCE_FRAMES``."""
X264_REFERENCE_FRAMES = 3

DEFAULT_REFERENCES = 3
"""Most references that an encoder chooses, unless it is told otherwise."""

_LEVELS = (
    (10, 1_485, 99, 396),
    (11, 3_000, 396, 900),
    (12, 6_000, 396, 2_376),
    (13, 11_880, 396, 2_376),
    (21, 19_800, 792, 4_752),
    (22, 20_250, 1_620, 8_100),
    (30, 40_500, 1_620, 8_100),
    (31, 108_000, 3_600, 18_000),
    (32, 216_000, 5_120, 20_480),
    (40, 245_760, 8_192, 32_768),
    (42, 522_240, 8_704, 34_816),
    (50, 589_824, 22_080, 110_400),
    (51, 983_040, 36_864, 184_320),
    (52, 2_073_600, 36_864, 184_320),
)
"""level_idc, MaxMBPS, MaxFS, MaxDpbMbs of ITU-T H.264 table A-1, without levels that add nothing
to the one before (2, 4.1) or need a constraint flag (1b)."""


class Coder(StrEnum):
    """The encoder of the slices."""

    OWN = "own"
    X264 = "x264"


def coder_of(effort: str) -> Coder:
    """Return the coder that has ``effort``."""
    return Coder.X264 if effort.startswith(_X264) else Coder.OWN


def effort_of_preset(preset: str) -> str:
    """Return the effort of x264's ``preset``."""
    return f"{_X264}{preset}"


def preset_of(effort: str) -> str:
    """Return the x264 preset of ``effort``; raise ``InvalidInput`` for an effort of our coder."""
    if coder_of(effort) is not Coder.X264:
        raise InvalidInput("effort", f"{effort!r} is no preset of x264")
    return effort.removeprefix(_X264)


def check_effort(field: str, effort: str) -> None:
    """Raise ``InvalidInput`` naming ``field`` unless one of the coders has ``effort``."""
    if effort not in EFFORTS:
        raise InvalidInput(field, f"{effort!r} is none of {', '.join(EFFORTS)}")


def check_crf(field: str, crf: float) -> None:
    """Raise ``InvalidInput`` naming ``field`` unless ``crf`` is within ``CRF_RANGE``."""
    low, high = CRF_RANGE
    if not low <= crf <= high:
        raise InvalidInput(field, f"{crf} is outside {low:g}..{high:g}")


def even_size_px(size_px: tuple[int, int]) -> tuple[int, int]:
    """Return (width, height) rounded up to even, which 4:2:0 cropping can express (7.4.2.1.1)."""
    width_px, height_px = size_px
    return (width_px + width_px % 2, height_px + height_px % 2)


@dataclass(frozen=True)
class CodecConfig:
    """One stream's size and quality. Raises ``InvalidInput`` naming the field that is wrong.

    ``effort`` is one of ``EFFORTS``. ``crf``, x264's constant rate factor: lower is better, 6 steps
    halve the quantiser; our coder takes it for a constant quantiser
    (``rfcore.codec.sender.picture_coder``).
    """

    width_px: int
    height_px: int
    effort: str = DEFAULT_EFFORT
    crf: float = 23.0

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px"):
            side = getattr(self, name)
            if not MIN_SIDE_PX <= side <= MAX_SIDE_PX:
                raise InvalidInput(
                    f"codec.{name}", f"{side} px is outside {MIN_SIDE_PX}..{MAX_SIDE_PX} px"
                )
        if self.macroblocks > MAX_MACROBLOCKS:
            raise InvalidInput(
                "codec.width_px x height_px",
                f"{self.width_px}x{self.height_px} px are {self.macroblocks} macroblocks, more "
                f"than the {MAX_MACROBLOCKS} of H.264 level 5.2; scale the pictures down",
            )
        check_effort("codec.effort", self.effort)
        check_crf("codec.crf", self.crf)

    @property
    def coder(self) -> Coder:
        """The encoder of the slices."""
        return coder_of(self.effort)

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of frames and renders."""
        return (self.width_px, self.height_px)

    @property
    def coded_size_px(self) -> tuple[int, int]:
        """The size as it is coded, rounded up to even."""
        return even_size_px(self.size_px)

    @property
    def size_mbs(self) -> tuple[int, int]:
        """(width, height) in macroblocks of 16x16 px."""
        return ((self.width_px + 15) // 16, (self.height_px + 15) // 16)

    @property
    def macroblocks(self) -> int:
        """The number of macroblocks of a picture."""
        return self.size_mbs[0] * self.size_mbs[1]

    @property
    def reference_frames(self) -> int:
        """Most references of a frame, as the parameter sets say."""
        return REFERENCE_FRAMES if self.coder is Coder.OWN else X264_REFERENCE_FRAMES

    @property
    def level_idc(self) -> int:
        """The lowest level that allows this size at 25 frames a second (A.3.1, table A-1)."""
        rate = PICTURES_PER_SECOND * self.macroblocks
        stored = self.reference_frames * self.macroblocks
        side = max(self.size_mbs)
        for level_idc, max_rate, max_size, max_stored in _LEVELS:
            small_enough = self.macroblocks <= max_size and side * side <= 8 * max_size
            if small_enough and rate <= max_rate and stored <= max_stored:
                return level_idc
        raise InvalidInput("codec.size", f"{self.size_px} px fit no level of H.264")

    @property
    def vertical_range(self) -> int:
        """Return the vertical range of motion vectors, in samples (MaxVmvR of table A-1)."""
        level = self.level_idc
        return 64 if level <= 10 else 128 if level <= 20 else 256 if level <= 30 else 512


class LightChange(StrEnum):
    """Permission to change the light of a render before frames are predicted from it."""

    AUTO = "auto"
    OFF = "off"


@dataclass(frozen=True)
class CoderSettings:
    """The encoder of the slices and its effort, as options of a command line."""

    coder: Coder = Coder.OWN
    """own: this project's slice coder. x264: for comparison, through FFmpeg."""
    effort: str | None = None
    """Effort of our own coder: fast, default or thorough."""
    preset: str | None = None
    """x264's preset with --coder x264: ultrafast to veryslow, normally medium."""
    check_decode: bool = False
    """Also decode every slice on the vehicle, and compare it with what its coder promised."""
    light: LightChange = LightChange.AUTO
    """auto: change the render's light to the frame's where that saves bits. off: predict from the
    render as it is."""

    def __post_init__(self) -> None:
        other = self.preset if self.coder is Coder.OWN else self.effort
        if other is not None:
            mine, named = ("effort", "preset")[:: 1 if self.coder is Coder.OWN else -1]
            raise InvalidInput(
                named, f"{other!r}: --coder {self.coder} has no --{named} but --{mine}"
            )
        if self.effort is not None and self.effort not in OWN_EFFORTS:
            raise InvalidInput("effort", f"{self.effort!r} is none of {', '.join(OWN_EFFORTS)}")
        if self.preset is not None and self.preset not in PRESETS:
            raise InvalidInput("preset", f"{self.preset!r} is none of {', '.join(PRESETS)}")

    @staticmethod
    def of(effort: str) -> CoderSettings:
        """Return the settings of an effort as ``CodecConfig`` has it."""
        check_effort("effort", effort)
        if coder_of(effort) is Coder.OWN:
            return CoderSettings(effort=effort)
        return CoderSettings(Coder.X264, preset=preset_of(effort))

    @property
    def arguments(self) -> tuple[str, ...]:
        """The settings as a command line gives them."""
        if self.coder is Coder.OWN:
            return ("--effort", self.name)
        return ("--coder", str(self.coder), "--preset", preset_of(self.name))

    @property
    def name(self) -> str:
        """The effort as ``CodecConfig`` has it."""
        if self.coder is Coder.OWN:
            return self.effort or DEFAULT_EFFORT
        return effort_of_preset(self.preset or "medium")
