"""Parses NMEA 0183 sentences of a GNSS receiver into fixes, by the library ``pynmea2``.

A receiver sends several sentences an epoch. GGA gives position, height and quality; RMC the date,
and the position where no GGA came until the second RMC; HDT and THS the heading of two antennas;
VTG and RMC the course over ground, which is the heading of a vehicle that drives; GST the standard
deviations, of the epoch before where it follows GGA. One fix an epoch is made. GGA's altitude is
above the geoid: without the geoid's separation the fix has no height. Other sentences are ignored.
A state machine: lines go in, fixes come out; ``now_ns`` only gives the day before the first RMC.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

from cav_agent.pose_feed.fix import BadReading, FeedProblem, Fix, finite
from rfcore.camera import Vec3
from rfcore.extras import needs

KNOT_MPS = 1852 / 3600
LEAST_SPEED_MPS = 1.5
"""Below this the course over ground says nothing about the heading."""
COURSE_STD_DEG = 3.0
HDT_STD_DEG = 1.0
SPREAD_M = {1: 3.0, 2: 1.0, 4: 0.03, 5: 0.3}
"""Standard deviation at HDOP 1 by GGA's quality (1 GNSS, 2 differential, 4 RTK fixed, 5 float)."""
LEAST_STD_M = 0.02
UNKNOWN_HEIGHT_STD_M = 50.0


@dataclass(frozen=True)
class Course:
    """A heading, degrees clockwise from north, and the number of the sentence it came in."""

    heading_deg: float
    std_deg: float
    sentence: int


class NmeaParser:
    """Parses one sentence after another, of any talker (GP, GN, GL, ...)."""

    def __init__(self) -> None:
        with needs("localise"):
            import pynmea2
        self._library: Any = pynmea2
        self._known_ns: int | None = None
        self._epoch: time | None = None
        self._has_gga = False
        self._rmc_alone = 0
        self._course: Course | None = None
        self._std_m: Vec3 | None = None
        self._sentences = 0
        self._takers: dict[str, Callable[[Any, int], Fix | None]] = {
            "GGA": self._gga,
            "RMC": self._rmc,
            "VTG": self._vtg,
            "HDT": self._hdt,
            "GST": self._gst,
        }

    def receive(self, sentence: str, now_ns: int) -> Fix | None:
        """Return the fix that a sentence completes, if it does; raise ``BadReading``."""
        self._sentences += 1
        try:
            message = self._library.parse(sentence, check=True)
            taker = self._takers.get(getattr(message, "sentence_type", ""))
            return None if taker is None else taker(message, now_ns)
        except self._library.SentenceTypeError:
            self._ths(sentence)
            return None
        except self._library.ChecksumError as error:
            raise BadReading(FeedProblem.CHECKSUM, f"{sentence[:80]!r}") from error
        except BadReading:
            raise
        except (self._library.ParseError, ValueError, TypeError, AttributeError) as error:
            raise BadReading(FeedProblem.MALFORMED, f"{sentence[:80]!r}") from error

    def _gga(self, message: Any, now_ns: int) -> Fix | None:
        quality = int(finite("GGA quality", message.gps_qual, 0, 9))
        if quality == 0:
            raise BadReading(FeedProblem.NO_FIX, "the receiver has no position")
        self._has_gga = True
        height_m = None
        if _is_given(message.altitude) and _is_given(message.geo_sep):
            separation_m = finite("GGA geoid", message.geo_sep, -200, 200)
            height_m = finite("GGA altitude", message.altitude, -1000, 10_000) + separation_m
        spread_m = SPREAD_M.get(quality, SPREAD_M[1])
        if _is_given(message.horizontal_dil):
            spread_m *= max(finite("GGA HDOP", message.horizontal_dil, 0, 100), 0.5)
        return self._fix(message, height_m, (spread_m, spread_m, 1.5 * spread_m), now_ns)

    def _rmc(self, message: Any, now_ns: int) -> Fix | None:
        if message.status != "A":
            raise BadReading(FeedProblem.NO_FIX, "the receiver has no position")
        if isinstance(message.datestamp, date) and isinstance(message.timestamp, time):
            self._known_ns = _unix_ns(message.datestamp, message.timestamp)
        if _is_given(message.true_course) and _is_given(message.spd_over_grnd):
            speed_mps = KNOT_MPS * finite("RMC speed", message.spd_over_grnd, 0, 1000)
            self._take_course(message.true_course, speed_mps)
        self._rmc_alone += 1
        if self._has_gga or self._rmc_alone == 1:  # a GGA with the height may follow
            return None
        spread_m = SPREAD_M[1]
        return self._fix(message, None, (spread_m, spread_m, spread_m), now_ns)

    def _vtg(self, message: Any, now_ns: int) -> None:  # noqa: ARG002
        if _is_given(message.true_track) and _is_given(message.spd_over_grnd_kmph):
            speed_mps = finite("VTG speed", message.spd_over_grnd_kmph, 0, 2000) / 3.6
            self._take_course(message.true_track, speed_mps)

    def _hdt(self, message: Any, now_ns: int) -> None:  # noqa: ARG002
        if _is_given(message.heading):
            self._take_heading("HDT", message.heading)

    def _ths(self, sentence: str) -> None:
        """Take a THS, which the library does not know; its checksum was right."""
        name, *values = sentence.strip().lstrip("$").partition("*")[0].split(",")
        if name[2:] == "THS" and len(values) == 2 and values[0] and values[1] != "V":
            self._take_heading("THS", values[0])

    def _take_heading(self, kind: str, value: Any) -> None:
        heading_deg = finite(f"{kind} heading", value, 0, 360)
        self._course = Course(heading_deg, HDT_STD_DEG, self._sentences)

    def _gst(self, message: Any, now_ns: int) -> None:  # noqa: ARG002
        names = ("std_dev_longitude", "std_dev_latitude", "std_dev_altitude")
        given = [getattr(message, name) for name in names]
        if all(map(_is_given, given)):
            east, north, up = (max(finite("GST", v, 0, 1e5), LEAST_STD_M) for v in given)
            self._std_m = (east, north, up)

    def _take_course(self, course_deg: Any, speed_mps: float) -> None:
        """Keep a course as the heading, unless the vehicle stands or two antennas know better."""
        heading_deg = finite("course", course_deg, 0, 360)
        known = self._course
        has_hdt = known is not None and known.std_deg < COURSE_STD_DEG and self._is_recent(known)
        if speed_mps >= LEAST_SPEED_MPS and not has_hdt:
            self._course = Course(heading_deg, COURSE_STD_DEG, self._sentences)

    def _is_recent(self, course: Course) -> bool:
        """Return whether a heading came within the last two epochs, of a dozen sentences each."""
        return self._sentences - course.sentence <= 24

    def _fix(self, message: Any, height_m: float | None, std_m: Vec3, now_ns: int) -> Fix | None:
        epoch = message.timestamp
        if not isinstance(epoch, time):
            raise BadReading(FeedProblem.MALFORMED, f"{message.sentence_type} without a time")
        if epoch == self._epoch:
            return None
        latitude_deg = finite("latitude", message.latitude, -90, 90)
        longitude_deg = finite("longitude", message.longitude, -180, 180)
        if not (_is_given(message.lat) and _is_given(message.lon)):
            raise BadReading(FeedProblem.MALFORMED, f"{message.sentence_type} without a position")
        self._epoch = epoch
        time_ns = _nearest_ns(epoch, now_ns if self._known_ns is None else self._known_ns)
        if self._known_ns is not None:
            self._known_ns = time_ns
        course = self._course
        if course is not None and not self._is_recent(course):
            course = self._course = None
        std_m = self._std_m or std_m
        if height_m is None:
            std_m = (*std_m[:2], UNKNOWN_HEIGHT_STD_M)
        return Fix(
            time_ns=time_ns,
            geodetic=(latitude_deg, longitude_deg, height_m),
            xyz_m=None,
            position_std_m=std_m,
            heading_deg=None if course is None else course.heading_deg,
            rotation_std_deg=COURSE_STD_DEG if course is None else course.std_deg,
        )


def _is_given(value: object) -> bool:
    return value is not None and value != ""


def _unix_ns(day: date, at: time) -> int:
    moment = datetime.combine(day, at.replace(tzinfo=UTC))
    return int((moment - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(microseconds=1)) * 1000


def _nearest_ns(at: time, near_ns: int) -> int:
    """Return the instant with this time of day that is nearest to another instant."""
    today = datetime.fromtimestamp(near_ns // 1_000_000_000, UTC).date()
    days = (today + timedelta(days=n) for n in (-1, 0, 1))
    return min((_unix_ns(day, at) for day in days), key=lambda ns: abs(ns - near_ns))
