"""``make dataset``: the sample's street as one archive, for others to use and cite.

A zip file with the street's training views, drives, points, fields and truth, a README, the
licence, a loader, and a manifest of SHA-256 digests. Equal files give equal bytes: names are
sorted, times fixed, nothing is compressed anew (pictures are compressed already).
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional

from rfcore.dataset import verify_manifest
from rfcore.errors import DatasetError
from rfcore.program import parse_options, run_program
from rfedge.results import revision

ROOT = Path(__file__).parents[1]
SAMPLE_SIZE = "640x360"
DRIVES = ("empty", "vehicles")
FIXED_TIME = (1980, 1, 1, 0, 0, 0)
"""The earliest that a zip file can state."""
POSE_TOLERANCE = 1e-6
"""Largest difference of a matrix's elements, metres; a pixel at 1 m is some millimetres wide."""
README = """# The sample street of rfedge, version 1

A street of 88 m, rendered by streetgen at {sizes}: training views of the empty street, and drives
of 24 frames at 10 Hz through it, empty and with vehicles that no training view shows. The drives
are lossless. Licence: Apache-2.0 (`LICENSE`); it may be used, changed and passed on.

| path | what |
|---|---|
{table}

`transforms_*.json` are in nerfstudio's format: OpenGL camera axes, z up, metres. Truth is depth
(16 bit, mm, 0 is none) and classes (named in `load_street.py`), pixel by pixel. `.rff` are fields
of 3D Gaussians, which rfedge reads; `rfedge field export` turns them into `.ply`.

    python load_street.py ARCHIVE.zip                 # checks every digest, lists the splits
    python load_street.py ARCHIVE.zip {split}

Made at revision {revision}. To cite: `CITATION.cff`.
"""


def release(samples: Path, sizes: Path, made_at: str, out: Path) -> list[str]:
    """Write the archive of ``samples`` and of what ``sizes`` has; return its splits.

    ``sizes`` holds a folder for each size, with ``train``, ``empty`` and ``vehicles`` as streetgen
    builds them, and ``SIZE.rff``; what was not rendered is left out, and the README says so. Raises
    ``DatasetError`` for damaged samples, and for truth whose poses are not those of the pictures.
    """
    files = {name: ROOT / name for name in ("LICENSE", "CITATION.cff")}
    files["load_street.py"] = ROOT / "examples/load_street.py"
    splits: dict[str, dict[str, str]] = {}
    for folder in ("street", "fields"):
        verify_manifest(samples / folder)
        files |= _under(samples / folder, f"{SAMPLE_SIZE}/{folder}", r".*\.(?!md$)\w+")
    for split in ("train", *(f"drive_{drive}" for drive in DRIVES)):
        pictures = f"{SAMPLE_SIZE}/street/transforms_{split}.json"
        splits[f"{SAMPLE_SIZE}/{split}"] = {"pictures": pictures}
    for built in sorted(sizes.glob("*x*/*/transforms_*.json")):
        size, part = built.parts[-3:-1]
        found = re.fullmatch(r"transforms_(train|drive)\.json", built.name)
        if found is None or part not in ("train", *DRIVES):
            continue
        at = f"{size}/{part}"
        name = f"{size}/{'train' if part == 'train' else f'drive_{part}'}"
        if size == SAMPLE_SIZE:  # its pictures are the sample's
            files |= _under(built.parent, at, r".*/(depth|classes)/.*\.png|transforms_\w+\.json")
            _check_poses(files[splits[name]["pictures"]], built)
        else:
            files |= _under(built.parent, at, r".*\.(png|ply|json)")
            splits[name] = {"pictures": f"{at}/{built.name}"}
        splits[name]["truth"] = f"{at}/{built.name}"
    for field in sorted(sizes.glob("*x*.rff")):
        files |= {f"fields/{each.name}": each for each in (field, field.with_suffix(".json"))}
    _write(files, splits, made_at, out)
    return sorted(splits)


def _under(folder: Path, at: str, pattern: str) -> dict[str, Path]:
    """Return the files below a folder whose relative paths match, by their names in the archive."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    named = {path.relative_to(folder).as_posix(): path for path in paths}
    return {f"{at}/{name}": path for name, path in named.items() if re.fullmatch(pattern, name)}


def _check_poses(pictures: Path, truth: Path) -> None:
    first, second = (
        np.array([frame["transform_matrix"] for frame in json.loads(path.read_bytes())["frames"]])
        for path in (pictures, truth)
    )
    if first.shape != second.shape or not np.allclose(first, second, rtol=0, atol=POSE_TOLERANCE):
        raise DatasetError(f"{truth}: its poses are not those of {pictures}; render it anew")


def _write(
    files: Mapping[str, Path], splits: Mapping[str, Mapping[str, str]], made_at: str, out: Path
) -> None:
    lines = [
        f"| `{name}` | `{split['pictures']}`{', with truth' if 'truth' in split else ''} |"
        for name, split in sorted(splits.items())
    ]
    sizes = ", ".join(sorted({name.partition("/")[0] for name in splits}, key=_width))
    told = {"sizes": sizes, "table": "\n".join(lines), "split": min(splits), "revision": made_at}
    texts = {"README.md": README.format(**told).encode()}
    digests = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
    digests["README.md"] = hashlib.sha256(texts["README.md"]).hexdigest()
    manifest: dict[str, Any] = {"dataset": "rfedge-street-1", "revision": made_at}
    manifest |= {"splits": splits, "sha256": dict(sorted(digests.items()))}
    texts["manifest.json"] = (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_suffix(".partial")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted({*files, *texts}):
            entry = zipfile.ZipInfo(name, FIXED_TIME)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, texts.get(name) or files[name].read_bytes())
    partial.replace(out)


def _width(size: str) -> int:
    return int(size.partition("x")[0])


@dataclass(frozen=True)
class DatasetRelease:
    """Write the archive of the sample's street."""

    out: Annotated[Path, Positional] = Path("out/rfedge-street-1.zip")
    """The archive."""
    sizes: Path = Path("out/results/size")
    """Folder of what was rendered and trained at other sizes."""

    def run(self) -> None:
        """Write it, and say what it holds; raise ``DatasetError``."""
        splits = release(ROOT / "samples", self.sizes, revision(), self.out)
        digest = hashlib.sha256(self.out.read_bytes()).hexdigest()
        print(f"{self.out}: {self.out.stat().st_size / 1e6:.1f} MB, sha256 {digest}")
        print(*splits, sep="\n")


def main() -> int:
    """Parse the command line and write; return the exit status."""
    return run_program("dataset", lambda: parse_options(DatasetRelease, "dataset").run())


if __name__ == "__main__":
    sys.exit(main())
