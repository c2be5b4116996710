"""Filter of system calls (seccomp, Linux): a list of the calls that readers of logs need; every other call is refused.

The list was traced with `strace -f` from the readers of every format (sound, damaged and oversized logs, aborts of
libraries, threads), on glibc. `_MARGIN` adds calls that other C libraries, kernels and processors make in place of
the traced ones. A call that is not on the list fails with EPERM, whether or not a kernel knows its number. Calls in
`_ABSENT` fail with ENOSYS, since libraries then use an older call that the filter can check.

Pages with PROT_EXEC stay allowed: libraries are loaded while a log is read, and the layer assumes that a hostile file
may already run native code in the reader.

Sources: the kernel's documentation "Seccomp BPF"; numbers from asm/unistd_64.h (x86_64) and asm-generic/unistd.h
(aarch64), in this order; None where an architecture does not have the call.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass

Numbers = tuple[int | None, int | None]
"""Number of a system call on x86_64 and on aarch64."""

_TRACED: dict[str, Numbers] = {
    # Files that are open or that the `open` rules below let through.
    "read": (0, 63), "write": (1, 64), "close": (3, 57), "lseek": (8, 62), "pread64": (17, 67), "readv": (19, 65),
    "fstat": (5, 80), "newfstatat": (262, 79), "stat": (4, None), "lstat": (6, None), "access": (21, None),
    "readlink": (89, None), "getcwd": (79, 17), "getdents64": (217, 61), "fadvise64": (221, 223),
    "pipe2": (293, 59),
    # Memory.
    "mmap": (9, 222), "mprotect": (10, 226), "munmap": (11, 215), "brk": (12, 214), "mremap": (25, 216),
    "madvise": (28, 233),
    # Threads and signals of this process.
    "futex": (202, 98), "set_robust_list": (273, 99), "rseq": (334, 293), "gettid": (186, 178), "getpid": (39, 172),
    "rt_sigaction": (13, 134), "rt_sigprocmask": (14, 135), "exit": (60, 93), "exit_group": (231, 94),
    # Time limits, which the reader sets again as checked headers announce work.
    "setitimer": (38, 103), "getitimer": (36, 102), "getrandom": (318, 278),
}  # fmt: skip
_MARGIN: dict[str, Numbers] = {
    # Newer, older or vectored forms of traced calls.
    "statx": (332, 291), "readlinkat": (267, 78), "faccessat": (269, 48), "faccessat2": (439, 439),
    "writev": (20, 66), "preadv": (295, 69), "preadv2": (327, 286), "readahead": (187, 213), "pipe": (22, None),
    "dup": (32, 23), "dup2": (33, None), "dup3": (292, 24), "eventfd2": (290, 19), "futex_waitv": (449, 449),
    "statfs": (137, 43), "fstatfs": (138, 44), "mincore": (27, 232),
    # Waiting.
    "poll": (7, None), "ppoll": (271, 73), "select": (23, None), "pselect6": (270, 72), "nanosleep": (35, 101),
    "clock_nanosleep": (230, 115), "sched_yield": (24, 124), "restart_syscall": (219, 128),
    # Clock calls, which reach the kernel only if the vDSO page is missing.
    "clock_gettime": (228, 113), "clock_getres": (229, 114), "gettimeofday": (96, 169), "time": (201, None),
    # Handlers of signals (faulthandler) and what a process asks about itself.
    "rt_sigreturn": (15, 139), "sigaltstack": (131, 132), "set_tid_address": (218, 96), "getcpu": (309, 168),
    "membarrier": (324, 283), "getppid": (110, 173), "getuid": (102, 174), "geteuid": (107, 175),
    "getgid": (104, 176), "getegid": (108, 177), "getrusage": (98, 165), "times": (100, 153), "uname": (63, 160),
    "sysinfo": (99, 179),
}  # fmt: skip
_ABSENT: dict[str, Numbers] = {
    # Their arguments lie in memory, where a filter cannot see them.
    "clone3": (435, 435), "openat2": (437, 437),
    "futex_wake": (454, 454), "futex_wait": (455, 455), "futex_requeue": (456, 456),
}  # fmt: skip
_WORD = 0xFFFFFFFF
NOT_READING = (
    os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    # O_TMPFILE: a file without a name; O_PATH: a handle of any path, which Landlock does not check.
    | 0o20000000 | 0o10000000
)  # fmt: skip
_THREAD = 0x10F00
"""Required flags of a new thread: CLONE_VM, CLONE_FS, CLONE_FILES, CLONE_SIGHAND and CLONE_THREAD."""
_THREAD_OPTIONS = 0x017C0000
"""Optional flags of a new thread: CLONE_SYSVSEM, _SETTLS, _PARENT_SETTID, _CHILD_CLEARTID, _DETACHED, _CHILD_SETTID."""
_FCNTL = (0, 1, 2, 3, 1030, 1032)
"""Allowed commands: F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_DUPFD_CLOEXEC, F_GETPIPE_SZ. The excluded F_SETOWN and
F_SETSIG send signals to other processes.
"""
_F_SETFL, _O_ASYNC = 4, 0o20000
_IOCTL = (0x5401, 0x802C542A, 0x5413, 0x541B, 0x5421, 0x5450, 0x5451)
"""Allowed requests: TCGETS, TCGETS2, TIOCGWINSZ, FIONREAD, FIONBIO, FIONCLEX, FIOCLEX. The excluded TIOCSTI types into
a terminal.
"""
_PRCTL = (15, 16, 0x53564D41)
"""Allowed options: PR_SET_NAME, PR_GET_NAME, PR_SET_VMA (names of memory areas)."""
_SHARED_LOCKS = 1 | 4 | 8
"""Allowed lock operations: LOCK_SH, LOCK_NB, LOCK_UN."""
_ARCHITECTURES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
_LOAD, _EQUAL, _AND, _RETURN = 0x20, 0x15, 0x54, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16
_ALLOW, _FAIL, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_SET_NO_NEW_PRIVILEGES, _SET_SECCOMP, _MODE_FILTER = 38, 22, 2
_UNUSED_NUMBER = 1023
"""System-call number that no kernel uses. Without a filter, the kernel refuses it with ENOSYS."""
Instruction = tuple[int, int, int, int]


@dataclass(frozen=True)
class Condition:
    """Test of one argument of a call: the masked low 32 bits are compared with a set of values.

    The kernel reads process ids, flags and commands as 32 bits, so higher bits change nothing.

    Attributes:
        argument: its index, from 0.
        mask: bits that are compared.
        values: allowed results.
    """

    argument: int
    mask: int
    values: tuple[int, ...]


@dataclass(frozen=True)
class CallForm:
    """A call that is allowed in some forms only.

    Attributes:
        numbers: the call.
        alternatives: each is a sequence of conditions that must all hold; one alternative is enough.
        refusal: error number of every other form.
    """

    numbers: Numbers
    alternatives: Sequence[Sequence[Condition]]
    refusal: int = errno.EPERM


def call_forms(own_pid: int) -> dict[str, CallForm]:
    """Return the calls whose arguments decide, by name.

    Args:
        own_pid: process id of the reader.
    """
    own, own_or_zero = Condition(0, _WORD, (own_pid,)), Condition(0, _WORD, (0, own_pid))
    return {
        "open": CallForm((2, None), [[Condition(1, NOT_READING, (0,))]]),
        "openat": CallForm((257, 56), [[Condition(2, NOT_READING, (0,))]]),
        "clone": CallForm((56, 220), [[Condition(0, _WORD & ~_THREAD_OPTIONS, (_THREAD,))]]),
        # A library that gives up ends its own process so (tkill: musl, main thread).
        "kill": CallForm((62, 129), [[own]]),
        "tkill": CallForm((200, 130), [[own]]),
        "tgkill": CallForm((234, 131), [[own]]),
        "prlimit64": CallForm((302, 261), [[own_or_zero]]),
        # ENOSYS: pthread_getattr_np then goes on without it, for a thread whose id differs from the process id.
        "sched_getaffinity": CallForm((204, 123), [[own_or_zero]], errno.ENOSYS),
        "fcntl": CallForm(
            (72, 25),
            [[Condition(1, _WORD, _FCNTL)], [Condition(1, _WORD, (_F_SETFL,)), Condition(2, _O_ASYNC, (0,))]],
        ),
        "ioctl": CallForm((16, 29), [[Condition(1, _WORD, _IOCTL)]]),
        "prctl": CallForm((157, 167), [[Condition(0, _WORD, _PRCTL)]]),
        "flock": CallForm((73, 32), [[Condition(1, _WORD & ~_SHARED_LOCKS, (0,))]]),
    }


def filter_program(column: int, architecture: int, own_pid: int) -> list[Instruction]:
    """Return the instructions (code, steps if true, steps if false, value) that decide about a call.

    Args:
        column: column of the tables above.
        architecture: the kernel's number of it.
        own_pid: process id of the reader.
    """
    program: list[Instruction] = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        # Numbers mean other calls on another architecture: whoever switches is killed.
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER_AT),
    ]
    for numbers in (_TRACED | _MARGIN).values():
        program += _answer(numbers[column], [(_RETURN, 0, 0, _ALLOW)])
    for form in call_forms(own_pid).values():
        # After a condition the accumulator holds an argument, so each form ends with an answer.
        body = [step for conditions in form.alternatives for step in _alternative(conditions)]
        program += _answer(form.numbers[column], [*body, (_RETURN, 0, 0, _FAIL | form.refusal)])
    for numbers in _ABSENT.values():
        program += _answer(numbers[column], [(_RETURN, 0, 0, _FAIL | errno.ENOSYS)])
    return [*program, (_RETURN, 0, 0, _FAIL | errno.EPERM)]


def _answer(number: int | None, body: list[Instruction]) -> list[Instruction]:
    return [] if number is None else [(_EQUAL, 0, len(body), number), *body]


def _alternative(conditions: Sequence[Condition]) -> list[Instruction]:
    """Return instructions that allow the call if all conditions hold, and otherwise run past their end."""
    steps: list[Instruction] = [(_RETURN, 0, 0, _ALLOW)]
    for condition in reversed(conditions):
        count = len(condition.values)
        tests: list[Instruction] = [
            # A match skips the tests that follow; the last test that fails skips the rest of the alternative.
            (_EQUAL, count - 1 - value_index, 0 if value_index < count - 1 else len(steps), value)
            for value_index, value in enumerate(condition.values)
        ]
        at = _ARGUMENTS_AT + 8 * condition.argument
        steps = [(_LOAD, 0, 0, at), (_AND, 0, 0, condition.mask), *tests, *steps]
    return steps


def restrict() -> None:
    """Filter the system calls of this process for good, and prove that the filter holds.

    Raises:
        OSError: the system, the architecture or the kernel has no such filter, or does not obey it.
    """
    if not sys.platform.startswith("linux"):
        raise OSError(errno.ENOSYS, "exists on Linux only")
    if platform.machine() not in _ARCHITECTURES or sys.byteorder != "little":
        raise OSError(errno.ENOSYS, f"is not written for the processor {platform.machine()}")
    column, architecture = _ARCHITECTURES[platform.machine()]
    program = filter_program(column, architecture, os.getpid())
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *step) for step in program))
    # struct sock_fprog: a count of 16 bits, then a pointer at its alignment.
    about = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    # The kernel takes a filter from a process without rights only after this.
    if libc.prctl(_SET_NO_NEW_PRIVILEGES, *map(ctypes.c_ulong, (1, 0, 0, 0))) or libc.prctl(
        _SET_SECCOMP, ctypes.c_ulong(_MODE_FILTER), about
    ):
        number = ctypes.get_errno()
        raise OSError(number, f"the kernel takes no filter ({os.strerror(number)})")
    # Without the filter the first call fails with ENOSYS and the second makes a socket.
    for call, arguments in ((libc.syscall, (_UNUSED_NUMBER,)), (libc.socket, (1, 1, 0))):
        if call(*arguments) != -1 or ctypes.get_errno() != errno.EPERM:
            raise OSError("the kernel took the filter and does not obey it")
