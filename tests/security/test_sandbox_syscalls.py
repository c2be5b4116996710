"""The filter of system calls as a rule: what is not listed is refused, whatever its number and its arguments."""

from __future__ import annotations

import errno
import os
import random

import pytest

from edp.sandbox import syscalls

OWN, OTHER = 4242, 4241
ALLOW = syscalls._ALLOW
REFUSED = syscalls._FAIL | errno.EPERM
ABSENT = syscalls._FAIL | errno.ENOSYS
COLUMNS = pytest.mark.parametrize(
    ("column", "architecture"), syscalls._ARCHITECTURES.values(), ids=["x86_64", "aarch64"]
)


def judged(program, architecture, number, *arguments):
    """What a kernel makes of a call: an interpreter of the instructions that the filter uses."""
    words = {0: number, 4: architecture}
    for place, argument in enumerate((*arguments, *[0] * (6 - len(arguments)))):
        words[16 + 8 * place] = argument & 0xFFFFFFFF
        words[20 + 8 * place] = argument >> 32 & 0xFFFFFFFF
    at = value = 0
    while True:
        code, true, false, operand = program[at]
        at += 1
        if code == syscalls._LOAD:
            value = words[operand]
        elif code == syscalls._AND:
            value &= operand
        elif code == syscalls._EQUAL:
            at += true if value == operand else false
        else:
            assert code == syscalls._RETURN
            return operand


@pytest.fixture
def judge(column, architecture):
    program = syscalls.filter_program(column, architecture, OWN)

    def of(number, *arguments):
        return judged(program, architecture, number, *arguments)

    of.program = program
    return of


def listed(column):
    return {
        numbers[column]
        for numbers in (*syscalls._TRACED.values(), *syscalls._MARGIN.values())
        if numbers[column] is not None
    }


def formed(column):
    return {form.numbers[column] for form in syscalls.call_forms(OWN).values() if form.numbers[column] is not None}


def absent(column):
    return {numbers[column] for numbers in syscalls._ABSENT.values()}


@COLUMNS
def test_every_number_outside_the_list_is_refused(judge, column):
    draw = random.Random(0)
    numbers = [*range(4096), *(draw.randrange(1 << 32) for _ in range(20_000))]
    for number in numbers:
        arguments = [draw.choice([0, OWN, OTHER, draw.randrange(1 << 64)]) for _ in range(6)]
        answer = judge(number, *arguments)
        if number in listed(column):
            assert answer == ALLOW
        elif number in absent(column):
            assert answer == ABSENT
        elif number not in formed(column):
            assert answer == REFUSED, number


@COLUMNS
def test_numbers_of_x32_are_refused_and_other_architectures_end_the_reader(judge, column, architecture):
    for number in range(1024):
        assert judge(number | 0x40000000, OWN, OWN) == REFUSED
    for other in (0x40000003, 0xC00000B7 if column == 0 else 0xC000003E, 0x40000028):
        assert judged(judge.program, other, 0) == syscalls._KILL


THREAD = 0x3D0F00
"""Flags with which glibc starts a thread."""
MUSL = 0x7D0F00
WAYS = [
    ("open", (0, os.O_RDONLY | os.O_CLOEXEC), True),
    *(("open", (0, flags), False) for flags in (1, 2, 0o100, 0o1000, 0o2000, 0o20200000, 0o10000000)),
    ("openat", (-100, 0, os.O_RDONLY | os.O_NOFOLLOW), True),
    *(("openat", (-100, 0, flags), False) for flags in (1, 2, 3, 0o100, 0o1000, 0o2000, 0o20200002, 0o10000000)),
    ("clone", (THREAD,), True),
    ("clone", (MUSL,), True),
    ("clone", (17,), False),
    ("clone", (0x1200011,), False),
    *(("clone", (THREAD | 1 << bit,), False) for bit in (12, 13, 14, 15, 17, 23, 25, 26, 27, 28, 29, 30, 31)),
    *(("clone", (THREAD & ~(1 << bit),), False) for bit in (8, 9, 10, 11, 16)),
    *((name, (pid, 9, 9), pid == OWN) for name in ("kill", "tgkill", "tkill") for pid in (OWN, OTHER, 0, 1, -1, -OWN)),
    *(("prlimit64", (pid, 7), pid in (0, OWN)) for pid in (0, OWN, OTHER, 1, -1)),
    ("fcntl", (3, 3), True),
    ("fcntl", (3, 1030), True),
    ("fcntl", (3, 4, os.O_NONBLOCK), True),
    ("fcntl", (3, 4, 0o20000), False),
    # F_SETOWN, F_SETSIG, F_SETOWN_EX, F_SETLEASE, F_NOTIFY, F_SETPIPE_SZ, F_ADD_SEALS, F_SETLK, F_SETLKW.
    *(("fcntl", (3, command), False) for command in (8, 10, 15, 1024, 1026, 1031, 1033, 6, 7)),
    ("ioctl", (0, 0x5401), True),
    # TIOCSTI, TIOCLINUX, TIOCSCTTY, FIOASYNC, FIOSETOWN, TIOCSPGRP, FS_IOC_SETFLAGS, FICLONE, PERF, TUNSETIFF.
    *(
        ("ioctl", (0, command), False)
        for command in (0x5412, 0x541C, 0x540E, 0x5452, 0x8901, 0x5410, 0x40086602, 0x40049409, 0x2400, 0x400454CA)
    ),
    ("prctl", (15,), True),
    # PDEATHSIG, DUMPABLE, SECCOMP, CAPBSET_DROP, NO_NEW_PRIVS, MM, PTRACER.
    *(("prctl", (option,), False) for option in (1, 4, 22, 24, 35, 38, 0x59616D61)),
    *(("flock", (3, operation), operation not in (2, 6)) for operation in (1, 5, 8, 2, 6)),
]


@COLUMNS
def test_calls_are_refused_in_the_forms_that_reach_others(judge, column):
    forms = syscalls.call_forms(OWN)
    for name, arguments, allowed in WAYS:
        form = forms[name]
        if form.numbers[column] is not None:
            # The kernel reads these arguments as 32 bits: what stands above them changes nothing.
            for high in (0, 1 << 32, 0xFFFFFFFF << 32):
                given = [argument & 0xFFFFFFFF | high for argument in arguments]
                assert judge(form.numbers[column], *given) == (ALLOW if allowed else REFUSED), (name, arguments)
    for pid in (0, OWN, OTHER):
        answer = judge(forms["sched_getaffinity"].numbers[column], pid)
        assert answer == (ALLOW if pid in (0, OWN) else ABSENT)
    assert {name for name, _, _ in WAYS} == set(forms) - {"sched_getaffinity"}


@COLUMNS
def test_the_filter_is_a_program_that_a_kernel_takes(judge, column):
    program = judge.program
    assert len(program) < 4096
    for place, (code, true, false, _) in enumerate(program):
        if code == syscalls._EQUAL:
            assert max(true, false) < 256
            assert max(true, false) + place + 1 < len(program)
    forms = [form.numbers[column] for form in syscalls.call_forms(OWN).values()]
    tables = (syscalls._TRACED, syscalls._MARGIN, syscalls._ABSENT)
    numbers = [entry[column] for table in tables for entry in table.values()] + forms
    numbers = [number for number in numbers if number is not None]
    assert len(numbers) == len(set(numbers))


def test_what_escaped_before_is_on_no_list():
    """Calls that reached the parent or a file outside while the filter was a list of what is refused."""
    for column, numbers in enumerate(
        (
            # setpriority, sched_setaffinity, setxattrat, open_tree_attr, file_setattr, ioprio_set, sched_setattr.
            (141, 203, 463, 467, 468, 469, 251, 314),
            (140, 122, 463, 467, 468, 469, 30, 274),
        )
    ):
        assert not set(numbers) & (listed(column) | formed(column))
