"""The two streets that faults are injected on: a small one, and the one that ships."""

from dataclasses import dataclass, replace
from pathlib import Path

from integration.conftest import CodedStreet, Street
from rfcore.field import FieldStore, load_field
from rfedge.loadtest.prerecorded import PrerecordedDrive, prerecorded_drive

SMALL, SHIPPED = "76x52", "640x360"
SAMPLES = Path(__file__).parents[2] / "samples"
SHIPPED_FIELD = SAMPLES / "fields/street.rff"
SHIPPED_DRIVE = SAMPLES / "street/transforms_drive_vehicles.json"


@dataclass(frozen=True)
class ShippedStreet(Street):
    """The field that ships, and its drive; ``packets``: the drive coded beforehand."""

    packets: Path

    @property
    def coded(self) -> CodedStreet:
        """Return what a vehicle would say, with frames that need their renders alone."""
        drive = PrerecordedDrive.read(self.packets)
        frames = [
            replace(frame, packet=replace(frame.packet, epoch=0, sequence=number))
            for number, frame in enumerate(drive.alone)
        ]
        return CodedStreet(replace(drive.hello, vehicle_id="cav-raw"), frames)


def shipped_street(root: Path) -> ShippedStreet:
    field_id = FieldStore(root / "store").add(SHIPPED_FIELD)
    field = load_field(SHIPPED_FIELD)
    packets = prerecorded_drive(SHIPPED_DRIVE, field, root / "packets")
    none = root / "other"
    return ShippedStreet(field, field_id, root / "store", SHIPPED_DRIVE, "", none, packets)
