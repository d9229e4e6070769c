"""The committed stubs are what the proto files generate."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def generate(out: Path) -> None:
    """Run protoc as `make proto` does; the plugins are found through this interpreter."""
    plugins = []
    for name, entry in (("mypy", "main"), ("mypy_grpc", "grpc")):
        script = out / f"protoc-gen-{name}"
        script.write_text(
            f"#!{sys.executable}\nfrom mypy_protobuf.main import {entry}\n{entry}()\n"
        )
        script.chmod(0o755)
        plugins.append(f"--plugin=protoc-gen-{name}={script}")
    kinds = ("python_out", "grpc_python_out", "mypy_out", "mypy_grpc_out")
    protos = sorted(str(p) for p in (ROOT / "proto").rglob("*.proto"))
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{ROOT / 'proto'}", *plugins]
    subprocess.run(
        [*command, *(f"--{kind}={out}" for kind in kinds), *protos],
        check=True,
        capture_output=True,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )


def test_the_stubs_match_the_proto_files(tmp_path: Path) -> None:
    generate(tmp_path)
    committed = ROOT / "rfcore/wire/v1"
    fresh = tmp_path / "rfcore/wire/v1"
    names = {p.name for p in fresh.iterdir()}
    assert names == {p.name for p in committed.iterdir() if "_pb2" in p.name}
    for name in sorted(names):
        same = (fresh / name).read_text() == (committed / name).read_text()
        assert same, f"{name} differs from its proto; run `make proto`"
