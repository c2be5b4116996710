"""Rules for files where the kernel has no Landlock: another process opens files for the reader (Linux 5.9 and later).

The process that was forked for a log divides in two. The child becomes the reader. The parent opens files for the
child: a filter of system calls hands each `open` and `openat` of the child to the parent, which resolves the path,
compares it with the list that Landlock would have had, opens the file itself and puts the handle into the child. The
child cannot change a path after the comparison, since the parent opens what it compared. The parent ends as the child
ended, so that nobody else sees a difference.

Source: the kernel's documentation "Seccomp BPF", section "Userspace Notification"; linux/seccomp.h.
"""

from __future__ import annotations

import array as array  # `socket.send_fds` imports it when files can no longer be opened
import ctypes
import errno
import json
import os
import platform
import select
import signal
import socket
import struct
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from edp.sandbox import landlock
from edp.sandbox.processes import die_with_parent
from edp.sandbox.syscalls import NOT_READING

_SECCOMP = {"x86_64": 317, "aarch64": 277}
_SET_FILTER, _GET_SIZES, _NEW_LISTENER = 1, 3, 8
_OPEN, _OPENAT = {"x86_64": 2, "aarch64": -1}, {"x86_64": 257, "aarch64": 56}
_RECEIVE, _SEND, _IS_VALID, _ADD_HANDLE = 0xC0502100, 0xC0182101, 0x40082102, 0x40182103
_NOTIFICATION = struct.Struct("=QIIiIQ6Q")
"""Kernel notification: identity, thread, flags, system call, architecture, instruction pointer, arguments."""
_ANSWER, _HANDLE = struct.Struct("=QqiI"), struct.Struct("=QIIII")
_ASK, _ALLOW = 0x7FC00000, 0x7FFF0000
_LONGEST_PATH = 4096
_MESSAGE_BYTES = 1 << 18
_CURRENT_FOLDER = -100
_NO_NEW_PRIVILEGES = 38


@dataclass
class _State:
    """Process that opens files for this reader; None without one."""

    channel: socket.socket | None = None


_state = _State()


def divide(pipes: Sequence[int]) -> None:
    """Split this process into a reader and a file opener if Landlock is missing and the kernel supports it.

    Returns in the child only. Called in a process with a single thread.

    Args:
        pipes: handles that only the reader needs.
    """
    if not is_available() or landlock.is_available():
        return
    mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    parent, child = os.getpid(), os.fork()
    if child == 0:
        mine.close()
        die_with_parent(parent)
        _state.channel = theirs
        return
    theirs.close()
    for pipe in pipes:
        os.close(pipe)
    try:
        _supervise(child, mine)
    except BaseException:
        # Nobody opens files for the reader any more: it could wait for ever.
        os.kill(child, signal.SIGKILL)
    _end_as(child)


def is_available() -> bool:
    """Return whether the kernel hands system calls to another process."""
    if not sys.platform.startswith("linux") or platform.machine() not in _SECCOMP:
        return False
    sizes = ctypes.create_string_buffer(6)
    libc = ctypes.CDLL(None, use_errno=True)
    return int(libc.syscall(_SECCOMP[platform.machine()], _GET_SIZES, 0, sizes)) == 0


def restrict(readable: Iterable[Path]) -> None:
    """Have this process's files opened by its parent from now on, and prove that the parent refuses others.

    Args:
        readable: files, or folders with all below them.

    Raises:
        OSError: there is no such parent, or the parent may not look into this process.
    """
    channel = _state.channel
    if channel is None:
        raise OSError("no other process can open files for the reader")
    _state.channel = None
    with channel:
        channel.send(json.dumps([os.fsdecode(path) for path in readable]).encode())
        if channel.recv(1) != b"y":
            raise OSError("the process that opens files may not look into the reader (ptrace_scope)")
        socket.send_fds(channel, [b"l"], [listener := _listen()])
        os.close(listener)
    os.close(os.open(os.devnull, os.O_RDONLY))
    try:
        handle = os.open(os.sep, os.O_RDONLY)
    except PermissionError:
        return
    os.close(handle)
    raise OSError("the process that opens files does not refuse others")


def _listen() -> int:
    """Return the handle that announces every later `open` and `openat` of this process."""
    machine = platform.machine()
    program = [(0x20, 0, 0, 0), (0x15, 2, 0, _OPEN[machine] & 0xFFFFFFFF), (0x15, 1, 0, _OPENAT[machine])]
    program += [(0x06, 0, 0, _ALLOW), (0x06, 0, 0, _ASK)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *step) for step in program))
    about = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_NO_NEW_PRIVILEGES, *map(ctypes.c_ulong, (1, 0, 0, 0)))
    listener = int(libc.syscall(_SECCOMP[machine], _SET_FILTER, _NEW_LISTENER, about))
    if listener < 0:
        raise OSError(ctypes.get_errno(), f"the kernel announces no calls ({os.strerror(ctypes.get_errno())})")
    return listener


def _supervise(child: int, channel: socket.socket) -> None:
    """Open files for the reader until it ends."""
    poll, ended = select.poll(), os.pidfd_open(child)
    poll.register(ended, select.POLLIN)
    text = channel.recv(_MESSAGE_BYTES)
    # The reader ended before it asked for anything.
    if not text:
        return
    try:
        memory = os.open(f"/proc/{child}/mem", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        channel.send(b"n")
        return
    channel.send(b"y")
    _, handles, _, _ = socket.recv_fds(channel, 1, 1)
    channel.close()
    if not handles:
        return
    opener = _Opener(child, memory, [Path(path) for path in json.loads(text)], handles[0])
    poll.register(handles[0], select.POLLIN)
    while not any(handle == ended for handle, _ in poll.poll()):
        opener.answer()


def _end_as(child: int) -> None:
    """End this process with the exit code or the signal with which a child ends."""
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code < 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [-code])
        if -code not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


class _Opener:
    """Opens files for one reader.

    Args:
        child: the reader.
        memory: handle of its memory.
        readable: files and folders that it may open.
        listener: descriptor that announces the system calls of the reader.
    """

    def __init__(self, child: int, memory: int, readable: Iterable[Path], listener: int) -> None:
        self.child, self.memory, self.listener = child, memory, listener
        # What the reader calls /proc/self has another name here.
        own = f"/proc/{child}"
        self.places = tuple(own if str(path) == "/proc/self" else os.path.realpath(path) for path in readable)
        self.below = tuple(os.path.join(folder, "") for folder in self.places)
        self.libc = ctypes.CDLL(None, use_errno=True)

    def answer(self) -> None:
        """Answer one call, if one waits."""
        notification = ctypes.create_string_buffer(_NOTIFICATION.size)
        if self._ioctl(_RECEIVE, notification) < 0:
            return
        identity, thread, _, call, _, _, *arguments = _NOTIFICATION.unpack(notification.raw)
        if call == _OPEN[platform.machine()]:
            arguments = [_CURRENT_FOLDER & 0xFFFFFFFF, *arguments]
        value, error = 0, 0
        try:
            handle = self._open(identity, thread, arguments)
        except OSError as failure:
            error = -(failure.errno or errno.EACCES)
        else:
            flags = arguments[2] & os.O_CLOEXEC
            value = self._ioctl(_ADD_HANDLE, ctypes.create_string_buffer(_HANDLE.pack(identity, 0, handle, 0, flags)))
            error = -ctypes.get_errno() if value < 0 else 0
            os.close(handle)
        self._ioctl(_SEND, ctypes.create_string_buffer(_ANSWER.pack(identity, max(value, 0), error, 0)))

    def _open(self, identity: int, thread: int, arguments: Sequence[int]) -> int:
        folder, address, flags = arguments[0] & 0xFFFFFFFF, arguments[1], arguments[2]
        path = self._path(thread, folder, self._text(address))
        # The thread may have ended, and another process may have got its number.
        if self._ioctl(_IS_VALID, ctypes.create_string_buffer(struct.pack("=Q", identity))) < 0:
            raise OSError(errno.EINTR, "gone")
        if flags & NOT_READING:
            raise OSError(errno.EPERM, "not for reading")
        if flags & os.O_NOFOLLOW and os.path.islink(path):
            raise OSError(errno.ELOOP, "a link")
        real = os.path.realpath(path)
        if real not in self.places and not real.startswith(self.below):
            raise OSError(errno.EACCES if os.path.lexists(real) else errno.ENOENT, "not on the list")
        # Without waiting for the other end of a pipe.
        handle = os.open(real, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | flags & os.O_DIRECTORY)
        if os.readlink(f"/proc/self/fd/{handle}") != real:
            os.close(handle)
            raise OSError(errno.EACCES, "another file by now")
        os.set_blocking(handle, not flags & os.O_NONBLOCK)
        return handle

    def _path(self, thread: int, folder: int, text: str) -> str:
        """Translate a path of the reader process to a path that is valid in this process."""
        own = f"/proc/{self.child}"
        if not text.startswith(os.sep):
            is_current = folder == _CURRENT_FOLDER & 0xFFFFFFFF
            base = os.readlink(f"{own}/cwd" if is_current else f"{own}/fd/{folder}")
            text = os.path.join(base, text)
        for name, real_name in (("/proc/self", own), ("/proc/thread-self", f"{own}/task/{thread}")):
            if text == name or text.startswith(f"{name}/"):
                return real_name + text.removeprefix(name)
        return text

    def _text(self, address: int) -> str:
        """Return a text that ends with a zero byte in the reader's memory."""
        text, page = b"", os.sysconf("SC_PAGE_SIZE")
        while b"\0" not in text:
            if len(text) > _LONGEST_PATH:
                raise OSError(errno.ENAMETOOLONG, "too long")
            at = address + len(text)
            # Up to the end of a page: the next one may not exist.
            part = os.pread(self.memory, page - at % page, at)
            if not part:
                raise OSError(errno.EFAULT, "no text")
            text += part
        return os.fsdecode(text.partition(b"\0")[0])

    def _ioctl(self, request: int, data: ctypes.Array[ctypes.c_char]) -> int:
        return int(self.libc.ioctl(self.listener, ctypes.c_ulong(request), data))
