"""Network namespaces and what connects them; needs root and ``ip`` (make test-system-packages)."""

import itertools
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import pytest

NUMBERS = itertools.count()


def run(*command: str) -> str:
    """Run a command; return what it prints."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def require(*names: str) -> None:
    """Skip without root; fail without the programs, which this machine could have."""
    if os.geteuid() != 0:
        pytest.skip("network namespaces need root")
    for name in names:
        if shutil.which(name) is None:
            pytest.fail(f"{name} is missing: run `make test-system-packages`")


def within(namespace: str) -> tuple[str, ...]:
    """Return what runs a command in a namespace."""
    return ("ip", "netns", "exec", namespace)


@contextmanager
def namespace(kind: str) -> Iterator[str]:
    """Yield a new namespace, whose loopback device is up."""
    name = f"rf{kind}{os.getpid()}-{next(NUMBERS)}"
    run("ip", "netns", "add", name)
    try:
        run("ip", "-n", name, "link", "set", "lo", "up")
        yield name
    finally:
        run("ip", "netns", "del", name)


@dataclass(frozen=True)
class Wire:
    """Two namespaces and the addresses of the ends, on devices ``rfnear`` and ``rffar``."""

    near: str
    far: str
    near_address: str = "10.213.0.1"
    far_address: str = "10.213.0.2"


@contextmanager
def connected() -> Iterator[Wire]:
    """Yield two new namespaces with a wire between them."""
    with ExitStack() as stack:
        ends = Wire(*(stack.enter_context(namespace(kind)) for kind in ("near", "far")))
        make = f"-n {ends.near} link add rfnear type veth peer name rffar netns {ends.far}"
        run("ip", *make.split())
        for name, device, address in (
            (ends.near, "rfnear", ends.near_address),
            (ends.far, "rffar", ends.far_address),
        ):
            run("ip", "-n", name, "addr", "add", f"{address}/24", "dev", device)
            run("ip", "-n", name, "link", "set", device, "up")
        yield ends
