"""The vendored libraries are those that vendor.json and SHA256SUMS say, with their licences."""

import hashlib
import json

from rfedge.twin.web import PAGE

VENDOR = PAGE / "vendor"


def test_every_file_has_its_noted_digest_and_none_is_unnoted() -> None:
    noted = dict(
        reversed(line.split()) for line in (VENDOR / "SHA256SUMS").read_text().splitlines()
    )
    names = {str(path.relative_to(VENDOR)) for path in VENDOR.rglob("*") if path.is_file()}
    assert names - {"vendor.json", "SHA256SUMS"} == noted.keys()
    for name, digest in noted.items():
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == digest, name


def test_every_package_brings_its_licence() -> None:
    packages = json.loads((VENDOR / "vendor.json").read_text())
    assert len(packages) == 3
    for package in packages:
        licence = (VENDOR / package["files"]["LICENSE"]).read_text()
        assert "Permission is hereby granted, free of charge" in licence


def test_the_page_names_no_other_host() -> None:
    for path in (*PAGE.glob("*.js"), PAGE / "index.html", PAGE / "style.css"):
        assert "http://" not in path.read_text()
        assert "https://" not in path.read_text()
