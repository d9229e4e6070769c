"""Filters of system calls: libseccomp has the same numbers; a BPF machine gives the verdicts."""

import ctypes
import ctypes.util
import struct
from collections.abc import Sequence

import pytest

from rfcore.confinement.confine import (
    MACHINES,
    NUMBERS,
    WHILE_READING,
    WHILE_STARTING,
    Allowed,
    Refusal,
    assembled,
    machine_column,
)
from rfcore.errors import BackendUnavailable

ALLOW = 0x7FFF0000
LIMIT = 600
"""No system call has a number as high yet."""


def verdict(program: bytes, machine: int, number: int, arguments: Sequence[int] = ()) -> int:
    """Run a classic BPF program over ``struct seccomp_data``, instruction by instruction."""
    data = struct.pack("=iIQ6Q", number, machine, 0, *(*arguments, *[0] * (6 - len(arguments))))
    code = list(struct.iter_unpack("=HBBI", program))
    at = accumulator = 0
    while True:
        operation, if_true, if_false, value = code[at]
        at += 1
        match operation:
            case 0x20:
                (accumulator,) = struct.unpack_from("=I", data, value)
            case 0x54:
                accumulator &= value
            case 0x15:
                at += if_true if accumulator == value else if_false
            case 0x35:
                at += if_true if accumulator >= value else if_false
            case 0x06:
                return int(value)
            case _:
                raise AssertionError(f"{operation:#x} is no instruction of ours")


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_those_of_libseccomp(machine: str, name: str) -> None:
    library = ctypes.util.find_library("seccomp")
    if library is None:
        pytest.fail("libseccomp is missing: run `make test-system-packages` (root, Debian)")
    resolve = ctypes.CDLL(library).seccomp_syscall_resolve_name_arch
    number = resolve(ctypes.c_uint32(MACHINES[machine]), name.encode())
    ours = NUMBERS[name][machine_column(machine)]
    assert (number if number >= 0 else None) == ours


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize(
    ("rules", "refusal"),
    [(WHILE_STARTING, Refusal.EPERM), (WHILE_READING, Refusal.KILL_PROCESS)],
)
def test_what_is_listed_is_allowed_and_nothing_else(
    machine: str, rules: tuple[Allowed, ...], refusal: Refusal
) -> None:
    program = assembled(rules, refusal, machine)
    column = machine_column(machine)
    numbers = {NUMBERS[rule.call][column]: rule for rule in rules}
    for number in range(LIMIT):
        rule = numbers.get(number)
        arguments = [0] * 6
        if rule is not None and rule.values:
            arguments[rule.argument] = rule.values[-1]
        expected = refusal.value if rule is None else ALLOW
        assert verdict(program, MACHINES[machine], number, arguments) == expected
        if rule is not None and rule.values:
            arguments[rule.argument] = rule.mask & ~rule.values[-1]
            assert verdict(program, MACHINES[machine], number, arguments) == refusal.value


@pytest.mark.parametrize("machine", MACHINES)
def test_another_table_of_system_calls_is_refused(machine: str) -> None:
    program = assembled(WHILE_READING, Refusal.EPERM, machine)
    read = NUMBERS["read"][machine_column(machine)]
    assert read is not None
    assert verdict(program, MACHINES[machine], read) == ALLOW
    for other in {0x40000003, *MACHINES.values()} - {MACHINES[machine]}:  # i386
        assert verdict(program, other, read) == Refusal.KILL_PROCESS.value
    assert verdict(program, MACHINES[machine], read | 0x40000000) == Refusal.EPERM.value  # x32


def test_a_machine_without_a_table_is_an_error() -> None:
    with pytest.raises(BackendUnavailable, match="no filter for riscv64, only for x86_64"):
        assembled(WHILE_READING, Refusal.EPERM, "riscv64")


def test_reading_allows_no_path_no_process_and_no_socket_of_its_own() -> None:
    calls = {rule.call for rule in WHILE_READING}
    assert not calls & {
        "open",
        "openat",
        "execve",
        "fcntl",
        "ioctl",
        "prctl",
        "dup",
        "wait4",
        "clone",
    }
    assert not {"socket", "connect", "fork", "kill", "ptrace", "unshare"} & set(NUMBERS)
