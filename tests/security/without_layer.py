"""Run a command as on a kernel that lacks a layer of the sandbox: ``python without_layer.py LAYER COMMAND ...``.

A filter of system calls makes the calls that the layer is made of fail as such kernels do; every child inherits it.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys

X86 = platform.machine() == "x86_64"
LOAD, EQUAL, RETURN = 0x20, 0x15, 0x06
ALLOW, FAIL = 0x7FFF0000, 0x00050000
NUMBER_AT, ARGUMENTS_AT = 0, 16
PRCTL, SECCOMP, PRLIMIT = (157, 317, 302) if X86 else (167, 277, 261)
PR_SET_SECCOMP = 22


def refused(number, error):
    return [(EQUAL, 0, 1, number), (RETURN, 0, 0, FAIL | error)]


LANDLOCK = [step for number in (444, 445, 446) for step in refused(number, errno.ENOSYS)]
LACKING = {
    # Another process opens files then, which needs a call that older kernels do not have.
    "Landlock": LANDLOCK,
    "file rules": [*LANDLOCK, *refused(SECCOMP, errno.ENOSYS)],
    "system-call filter": [
        *refused(SECCOMP, errno.ENOSYS),
        (EQUAL, 0, 4, PRCTL),
        (LOAD, 0, 0, ARGUMENTS_AT),
        (EQUAL, 0, 1, PR_SET_SECCOMP),
        (RETURN, 0, 0, FAIL | errno.EINVAL),
        (RETURN, 0, 0, ALLOW),
    ],
    # Limits can be asked for and not set.
    "limits": [
        (EQUAL, 0, 4, PRLIMIT),
        (LOAD, 0, 0, ARGUMENTS_AT + 2 * 8),
        (EQUAL, 1, 0, 0),
        (RETURN, 0, 0, FAIL | errno.EPERM),
        (RETURN, 0, 0, ALLOW),
    ],
    "": [],
}


def lose(layer: str) -> None:
    program = [(LOAD, 0, 0, NUMBER_AT), *LACKING[layer], (RETURN, 0, 0, ALLOW)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *step) for step in program))
    about = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(38, *map(ctypes.c_ulong, (1, 0, 0, 0))) or libc.prctl(PR_SET_SECCOMP, ctypes.c_ulong(2), about):
        raise OSError(ctypes.get_errno(), "no filter of system calls here")


if __name__ == "__main__":
    lose(sys.argv[1])
    os.execv(sys.argv[2], sys.argv[2:])
