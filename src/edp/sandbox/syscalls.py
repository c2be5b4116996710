"""A filter of system calls (seccomp, Linux): no network, no new programs or processes, no change of any file.

Source: the kernel's documentation "Seccomp BPF"; numbers from asm/unistd_64.h (x86_64) and asm-generic/unistd.h
(aarch64), in this order; None where an architecture has no such call. A refused call fails with EPERM; the newer forms
of calls whose arguments a filter cannot see fail with ENOSYS, so that libraries use the older forms.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys

_NETWORK = {
    "socket": (41, 198), "socketpair": (53, 199), "connect": (42, 203), "bind": (49, 200), "listen": (50, 201),
    "accept": (43, 202), "accept4": (288, 242), "sendto": (44, 206), "sendmsg": (46, 211), "sendmmsg": (307, 269),
    "recvfrom": (45, 207), "recvmsg": (47, 212), "recvmmsg": (299, 243),
    # Rings do what calls do, past any filter.
    "io_uring_setup": (425, 425), "io_uring_enter": (426, 426), "io_uring_register": (427, 427),
}  # fmt: skip
_PROGRAMS = {
    "execve": (59, 221), "execveat": (322, 281), "fork": (57, None), "vfork": (58, None), "ptrace": (101, 117),
    "process_vm_readv": (310, 270), "process_vm_writev": (311, 271), "process_madvise": (440, 440), "kcmp": (312, 272),
    "pidfd_open": (434, 434), "pidfd_getfd": (438, 438), "pidfd_send_signal": (424, 424), "tkill": (200, 130),
    "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240), "uselib": (134, None),
}  # fmt: skip
_SYSTEM = {
    "mount": (165, 40), "umount2": (166, 39), "pivot_root": (155, 41), "chroot": (161, 51), "unshare": (272, 97),
    "setns": (308, 268), "move_mount": (429, 429), "open_tree": (428, 428), "fsopen": (430, 430),
    "fsconfig": (431, 431), "fsmount": (432, 432), "fspick": (433, 433), "mount_setattr": (442, 442),
    "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282), "keyctl": (250, 219),
    "add_key": (248, 217), "request_key": (249, 218), "init_module": (175, 105), "finit_module": (313, 273),
    "delete_module": (176, 106), "kexec_load": (246, 104), "kexec_file_load": (320, 294), "reboot": (169, 142),
    "swapon": (167, 224), "swapoff": (168, 225), "acct": (163, 89), "quotactl": (179, 60), "syslog": (103, 116),
    "personality": (135, 92), "modify_ldt": (154, None), "iopl": (172, None), "ioperm": (173, None),
    "sethostname": (170, 161), "setdomainname": (171, 162), "settimeofday": (164, 170), "clock_settime": (227, 112),
    "clock_adjtime": (305, 266), "adjtimex": (159, 171), "vhangup": (153, 58), "lookup_dcookie": (212, 18),
    "setuid": (105, 146), "setgid": (106, 144), "setreuid": (113, 145), "setregid": (114, 143),
    "setresuid": (117, 147), "setresgid": (119, 149), "setgroups": (116, 159), "capset": (126, 91),
    "inotify_init": (253, None), "inotify_init1": (294, 26), "fanotify_init": (300, 262),
    "shmget": (29, 194), "shmat": (30, 196), "shmctl": (31, 195), "msgget": (68, 186), "msgsnd": (69, 189),
    "msgrcv": (70, 188), "msgctl": (71, 187), "semget": (64, 190), "mq_open": (240, 180), "mq_unlink": (241, 181),
}  # fmt: skip
_FILES = {
    "creat": (85, None), "rename": (82, None), "renameat": (264, 38), "renameat2": (316, 276), "link": (86, None),
    "linkat": (265, 37), "symlink": (88, None), "symlinkat": (266, 36), "unlink": (87, None), "unlinkat": (263, 35),
    "mkdir": (83, None), "mkdirat": (258, 34), "rmdir": (84, None), "mknod": (133, None), "mknodat": (259, 33),
    "chmod": (90, None), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452), "chown": (92, None),
    "fchown": (93, 55), "lchown": (94, None), "fchownat": (260, 54), "utime": (132, None), "utimes": (235, None),
    "utimensat": (280, 88), "futimesat": (261, None), "setxattr": (188, 5), "lsetxattr": (189, 6),
    "fsetxattr": (190, 7), "removexattr": (197, 14), "lremovexattr": (198, 15), "fremovexattr": (199, 16),
    "truncate": (76, 45), "ftruncate": (77, 46), "fallocate": (285, 47), "open_by_handle_at": (304, 265),
    "name_to_handle_at": (303, 264),
}  # fmt: skip
_UNSEEN = {"clone3": (435, 435), "openat2": (437, 437)}
_CLONE, _OPEN, _OPENAT = (56, 220), (2, None), (257, 56)
_SIGNALS = {"kill": (62, 129), "tgkill": (234, 131)}
"""Allowed towards this process itself: a library that gives up ends it so."""
_ARCHITECTURES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
_X32 = 0x40000000
"""Set in the numbers of the calls of another interface of x86_64, which pass by the numbers above."""
_CLONE_THREAD = 0x10000
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16
_ALLOW, _FAIL, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_SET_NO_NEW_PRIVILEGES, _SET_SECCOMP, _MODE_FILTER = 38, 22, 2
Instruction = tuple[int, int, int, int]


def filter_program(column: int, architecture: int, own_pid: int) -> list[Instruction]:
    """The instructions (code, steps if true, steps if false, value) that judge a call.

    Args:
        column: of the tables above.
        architecture: the kernel's name of it.
        own_pid: the process that signals may be sent to.
    """
    refuse: Instruction = (_RETURN, 0, 0, _FAIL | errno.EPERM)
    allow: Instruction = (_RETURN, 0, 0, _ALLOW)
    program: list[Instruction] = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        # Numbers mean other calls on another architecture: whoever switches is killed.
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER_AT),
        (_AT_LEAST, 0, 1, _X32),
        refuse,
    ]
    for table, answer in ((_NETWORK | _PROGRAMS | _SYSTEM | _FILES, errno.EPERM), (_UNSEEN, errno.ENOSYS)):
        for numbers in table.values():
            number = numbers[column]
            if number is not None:
                program += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _FAIL | answer)]

    def judge(numbers: tuple[int | None, int | None], argument: int, test: Instruction, fitting: Instruction) -> None:
        """Where the argument (its low 32 bits) passes the test: `fitting`, else the other answer."""
        number = numbers[column]
        if number is not None:
            # Steps count instructions: past the load, the test and its two answers.
            program.append((_EQUAL, 0, 4, number))
            program.append((_LOAD, 0, 0, _ARGUMENTS_AT + 8 * argument))
            program.extend([test, fitting, allow if fitting is refuse else refuse])

    # Threads are allowed, processes are not.
    judge(_CLONE, 0, (_ANY_BIT, 0, 1, _CLONE_THREAD), allow)
    for numbers in _SIGNALS.values():
        judge(numbers, 0, (_EQUAL, 0, 1, own_pid), allow)
    # Opening for reading is left to Landlock, which sees paths; a filter sees only numbers.
    judge(_OPEN, 1, (_ANY_BIT, 0, 1, _WRITING), refuse)
    judge(_OPENAT, 2, (_ANY_BIT, 0, 1, _WRITING), refuse)
    return [*program, allow]


def restrict() -> bool:
    """Filter the system calls of this process for good.

    Returns:
        whether the kernel does so; False on other systems and architectures.
    """
    if not sys.platform.startswith("linux") or platform.machine() not in _ARCHITECTURES or sys.byteorder != "little":
        return False
    column, architecture = _ARCHITECTURES[platform.machine()]
    program = filter_program(column, architecture, os.getpid())
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *step) for step in program))
    # struct sock_fprog: a count of 16 bits, then a pointer at its alignment.
    about = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    # The kernel takes a filter from a process without rights only after this.
    if libc.prctl(_SET_NO_NEW_PRIVILEGES, *map(ctypes.c_ulong, (1, 0, 0, 0))):
        return False
    return bool(libc.prctl(_SET_SECCOMP, ctypes.c_ulong(_MODE_FILTER), about) == 0)
