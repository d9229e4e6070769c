"""Fetch the JavaScript libraries of the twin's page anew: ``python deploy/vendor_twin.py``.

Reads vendor.json beside them, has npm download each package, compares its digest with the one
noted there, and copies the named files. Needs npm and its registry; what it writes is committed.
"""

import base64
import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

VENDOR = Path(__file__).parents[1] / "rfedge" / "twin" / "page" / "vendor"


def main() -> None:
    """Fetch, check and unpack every package."""
    packages = json.loads((VENDOR / "vendor.json").read_text(encoding="utf-8"))
    sums: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for package in packages:
            archive = download(package, Path(folder))
            sums |= unpacked(archive, package["files"])
    lines = (f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    (VENDOR / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


def download(package: dict[str, str], folder: Path) -> Path:
    """Return the package's archive, once its digest is the one noted."""
    name = f"{package['package']}@{package['version']}"
    command = ["npm", "pack", "--silent", name, "--pack-destination", str(folder)]
    file = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1]
    data = (folder / file).read_bytes()
    found = "sha512-" + base64.b64encode(hashlib.sha512(data).digest()).decode()
    if found != package["integrity"]:
        sys.exit(f"{name} has digest {found}, vendor.json says {package['integrity']}")
    return folder / file


def unpacked(archive: Path, files: dict[str, str]) -> dict[str, str]:
    """Copy the named files of the archive; return the SHA-256 of each by where it lies now."""
    sums = {}
    with tarfile.open(archive) as tar:
        for source, target in files.items():
            member = tar.extractfile(f"package/{source}")
            if member is None:
                sys.exit(f"{archive.name} has no file {source}")
            path = VENDOR / target
            path.parent.mkdir(parents=True, exist_ok=True)
            data = member.read()
            path.write_bytes(data)
            sums[target] = hashlib.sha256(data).hexdigest()
    return sums


if __name__ == "__main__":
    main()
