"""Which system calls a process that reads strangers' files may make: a filter of seccomp(2).

All others are refused with an error. The list is what the readers of all formats were seen to call,
and what the C library calls in their place on other machines.
"""

import ctypes
import errno
import platform
import struct
import sys
from collections.abc import Iterator

from service.wire.libc import LIBC, checked

_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 22, 2  # prctl(2)
# The numbers of calls on each machine; None where there is no such call.
_MACHINES = ("x86_64", "aarch64")
_ARCHITECTURES = (0xC000003E, 0xC00000B7)
ALLOWED: dict[str, tuple[int, int | None]] = {
    # memory
    "brk": (12, 214),
    "mmap": (9, 222),
    "munmap": (11, 215),
    "mremap": (25, 216),
    "mprotect": (10, 226),
    "madvise": (28, 233),
    # open files, and the socket that a body comes through
    "read": (0, 63),
    "write": (1, 64),
    "readv": (19, 65),
    "writev": (20, 66),
    "pread64": (17, 67),
    "pwrite64": (18, 68),
    "lseek": (8, 62),
    "close": (3, 57),
    "fstat": (5, 80),
    "ftruncate": (77, 46),
    "fallocate": (285, 47),
    "fadvise64": (221, 223),
    "dup": (32, 23),
    "flock": (73, 32),
    "recvfrom": (45, 207),
    "sendto": (44, 206),
    "poll": (7, None),
    "ppoll": (271, 73),
    # names of files, which Landlock and a root of its own bound
    "open": (2, None),
    "openat": (257, 56),
    "stat": (4, None),
    "lstat": (6, None),
    "newfstatat": (262, 79),
    "statx": (332, 291),
    "access": (21, None),
    "faccessat": (269, 48),
    "readlink": (89, None),
    "readlinkat": (267, 78),
    "getcwd": (79, 17),
    "chdir": (80, 49),
    "getdents64": (217, 61),
    "mkdir": (83, None),
    "mkdirat": (258, 34),
    "unlink": (87, None),
    "unlinkat": (263, 35),
    "rmdir": (84, None),
    "rename": (82, None),
    "renameat": (264, 38),
    # the process itself
    "getpid": (39, 172),
    "gettid": (186, 178),
    "getuid": (102, 174),
    "geteuid": (107, 175),
    "getgid": (104, 176),
    "getegid": (108, 177),
    "getrandom": (318, 278),
    "sched_yield": (24, 124),
    "futex": (202, 98),
    "clock_gettime": (228, 113),
    "clock_nanosleep": (230, 115),
    "gettimeofday": (96, 169),
    "time": (201, None),
    "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135),
    "rt_sigreturn": (15, 139),
    "sigaltstack": (131, 132),
    "restart_syscall": (219, 128),
    "exit": (60, 93),
    "exit_group": (231, 94),
}
_FCNTL, _IOCTL, _CLONE3 = (72, 25), (16, 29), (435, 435)
_MOST_FCNTL, _DUPLICATE = 8, 1030  # commands below are of flags and locks, later ones of signals
_X32 = 0x40000000  # numbers from here on are those of another set of calls
_ALLOW, _KILL = 0x7FFF0000, 0x80000000
_ERROR = 0x50000  # with the number of the error
_DENY = _ERROR | errno.EPERM
_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06  # of BPF
_NUMBER, _ARCHITECTURE, _SECOND = 0, 4, 24  # places in ``struct seccomp_data``


def can_be_bounded() -> bool:
    """Whether the kernel takes filters: it then finds fault with the address of none."""
    if sys.platform != "linux" or platform.machine() not in _MACHINES:
        return False
    LIBC.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, None, 0, 0)
    return ctypes.get_errno() == errno.EFAULT


def bound_calls() -> None:
    """Have this process make the allowed calls alone, for good."""
    program = list(_filter(_MACHINES.index(platform.machine())))
    code = ctypes.create_string_buffer(b"".join(program))

    class Program(ctypes.Structure):  # struct sock_fprog
        _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))

    given = Program(len(program), ctypes.addressof(code))
    checked(LIBC.prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(given), 0, 0))


def _filter(machine: int) -> Iterator[bytes]:
    """Yield the instructions of a filter: each is a kind, jumps if so and if not, and a number.

    What it looks at is ``struct seccomp_data``: the number of the call at 0, the architecture at
    4, the arguments from 16 on, of 8 bytes each.
    """

    def step(kind: int, number: int, then: int = 0, otherwise: int = 0) -> bytes:
        return struct.pack("=HBBI", kind, then, otherwise, number)

    yield step(_LOAD, _ARCHITECTURE)
    yield step(_EQUAL, _ARCHITECTURES[machine], 1)
    yield step(_RETURN, _KILL)
    yield step(_LOAD, _NUMBER)
    yield step(_AT_LEAST, _X32, 0, 1)
    yield step(_RETURN, _DENY)
    for numbers in ALLOWED.values():
        if (number := numbers[machine]) is not None:
            yield step(_EQUAL, number, 0, 1)
            yield step(_RETURN, _ALLOW)
    for refused, error in (
        (_CLONE3, errno.ENOSYS),  # libraries then try an older call
        (_IOCTL, errno.ENOTTY),  # what is opened is no terminal, which is asked of every file
    ):
        yield step(_EQUAL, refused[machine], 0, 1)
        yield step(_RETURN, _ERROR | error)
    yield step(_EQUAL, _FCNTL[machine], 0, 4)
    yield step(_LOAD, _SECOND)
    yield step(_EQUAL, _DUPLICATE, 1, 0)
    yield step(_AT_LEAST, _MOST_FCNTL, 1, 0)
    yield step(_RETURN, _ALLOW)
    yield step(_RETURN, _DENY)
