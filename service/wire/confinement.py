"""Confining this process to one folder or none, where the kernel can: Landlock and seccomp (Linux).

Whatever a library can be brought to do by the file that it reads, it then does without other
files, without the network, without other processes and their memory, and without programs.
See landlock(7) and seccomp(2).
"""

import ctypes
import errno
import os
import platform
import struct
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 38, 22, 2  # prctl(2)
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on every architecture
_ABI_VERSION, _PATH_BENEATH = 1, 1
# Rights on files, by bit: run, write, read, list, remove a folder or a file, make a device, a
# folder, a file, a socket, a FIFO, a block device, a symbolic link, move, truncate, ioctl.
_ALL, _LIST, _READ = (1 << 13) - 1, 1 << 3, 1 << 2
_WORK = _READ | _LIST | 1 << 1 | 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8  # in the folder
_MOVE, _TRUNCATE, _IOCTL = 1 << 13, 1 << 14, 1 << 15  # known since the versions 2, 3 and 5
_TCP = 0b11  # bind and connect, known since version 4
_SCOPED = 0b11  # abstract sockets of others and signals to them, known since version 6

# The numbers of calls on each machine.
_MACHINES = ("x86_64", "aarch64")
_ARCHITECTURES = (0xC000003E, 0xC00000B7)
# Refused: sockets, programs, other processes, and what has often been a way around such filters.
_REFUSED = {
    "socket": (41, 198),
    "socketpair": (53, 199),
    "connect": (42, 203),
    "bind": (49, 200),
    "listen": (50, 201),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "pidfd_getfd": (438, 438),
    "execve": (59, 221),
    "execveat": (322, 281),
    "kill": (62, 129),
    "tkill": (200, 130),
    "tgkill": (234, 131),
    "rt_sigqueueinfo": (129, 138),
    "pidfd_send_signal": (424, 424),
    "io_uring_setup": (425, 425),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "userfaultfd": (323, 282),
    "keyctl": (250, 219),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "unshare": (272, 97),
    "setns": (308, 268),
    "mount": (165, 40),
    "open_by_handle_at": (304, 265),
    "shmget": (29, 194),
    "msgget": (68, 186),
    "semget": (64, 190),
    "mq_open": (240, 180),
    "fork": (57, None),
    "vfork": (58, None),
}
_CLONE, _CLONE3, _PRLIMIT = (56, 220), (435, 435), (302, 261)
_X32 = 0x40000000  # numbers from here on are those of another set of calls
_CLONE_THREAD = 0x10000
_ALLOW, _KILL = 0x7FFF0000, 0x80000000
_DENY, _UNKNOWN = 0x50000 | errno.EPERM, 0x50000 | errno.ENOSYS
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06  # of BPF


def available() -> tuple[str, ...]:
    """Return by which means of the kernel processes can be confined here."""
    means = {
        "landlock": _landlock_version() > 0,
        "seccomp": _has_seccomp(),
    }
    return tuple(name for name, has in means.items() if has)


def confine(folder: Path | None) -> None:
    """Confine this process, for good, to a folder, if any, and to reading Python's libraries.

    Without support of the kernel nothing happens; `available` returns what it supports.

    Raises
    ------
    OSError
        If the kernel supports it, but refuses.
    """
    means = available()
    if means:
        _checked(_LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    if "landlock" in means:
        _restrict_files(folder)
    if "seccomp" in means:
        _restrict_calls(_MACHINES.index(platform.machine()))


def _libraries() -> set[Path]:
    """Return the folders of Python's own modules, of installed packages and of shared libraries."""
    kinds = ("stdlib", "platstdlib", "purelib", "platlib")
    python = [Path(sysconfig.get_path(kind)) for kind in kinds]
    return {
        path.resolve()
        for path in (*python, *map(Path, ("/lib", "/lib64", "/usr/lib", "/usr/lib64")))
        if path.is_dir()
    }


def _landlock_version() -> int:
    """Return the version of Landlock's interface; 0 or less where there is none."""
    if sys.platform != "linux":
        return 0
    return int(_LIBC.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _ABI_VERSION))


def _has_seccomp() -> bool:
    """Whether the kernel takes filters: it then finds fault with the address of none."""
    if sys.platform != "linux" or platform.machine() not in _MACHINES:
        return False
    _LIBC.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, None, 0, 0)
    return ctypes.get_errno() == errno.EFAULT


def _restrict_files(folder: Path | None) -> None:
    version = _landlock_version()
    files = _ALL
    for since, right in ((2, _MOVE), (3, _TRUNCATE), (5, _IOCTL)):
        files |= right if version >= since else 0
    rules = struct.pack("=Q", files)
    if version >= 4:
        rules += struct.pack("=Q", _TCP)
    if version >= 6:
        rules += struct.pack("=Q", _SCOPED)
    ruleset = _checked(_LIBC.syscall(_CREATE_RULESET, rules, ctypes.c_size_t(len(rules)), 0))
    allowed = dict.fromkeys(_libraries(), _READ | _LIST | 1)
    if folder is not None:
        allowed[folder.resolve()] = _WORK | (_TRUNCATE if version >= 3 else 0)
    for path, rights in allowed.items():
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
        rule = struct.pack("=Qi", rights, place)
        _checked(_LIBC.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
        os.close(place)
    _checked(_LIBC.syscall(_RESTRICT_SELF, ruleset, 0))
    os.close(ruleset)


def _restrict_calls(machine: int) -> None:
    program = list(_filter(machine))
    code = ctypes.create_string_buffer(b"".join(program))

    class Program(ctypes.Structure):  # struct sock_fprog
        _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))

    given = Program(len(program), ctypes.addressof(code))
    _checked(_LIBC.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(given), 0, 0))


def _filter(machine: int) -> Iterator[bytes]:
    """Yield the instructions of a filter: each is a kind, jumps if so and if not, and a number.

    What it looks at is ``struct seccomp_data``: the number of the call at 0, the architecture at
    4, the arguments from 16 on, of 8 bytes each.
    """

    def step(kind: int, number: int, then: int = 0, otherwise: int = 0) -> bytes:
        return struct.pack("=HBBI", kind, then, otherwise, number)

    yield step(_LOAD, 4)
    yield step(_EQUAL, _ARCHITECTURES[machine], 1)
    yield step(_RETURN, _KILL)
    yield step(_LOAD, 0)
    yield step(_AT_LEAST, _X32, 0, 1)
    yield step(_RETURN, _DENY)
    for numbers in _REFUSED.values():
        if (number := numbers[machine]) is not None:
            yield step(_EQUAL, number, 0, 1)
            yield step(_RETURN, _DENY)
    yield step(_EQUAL, _CLONE3[machine], 0, 1)
    yield step(_RETURN, _UNKNOWN)  # libraries then use clone, whose flags can be looked at
    yield step(_EQUAL, _CLONE[machine], 0, 2)
    yield step(_LOAD, 16)
    yield step(_ANY_BIT, _CLONE_THREAD, 3, 4)
    yield step(_EQUAL, _PRLIMIT[machine], 0, 2)
    yield step(_LOAD, 16)
    yield step(_EQUAL, 0, 0, 1)  # limits of this process
    yield step(_RETURN, _ALLOW)
    yield step(_RETURN, _DENY)


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return int(result)
