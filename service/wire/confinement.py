"""Confining this process to one folder or none, where the kernel can (Linux).

Whatever a library can be brought to do by the file that it reads, it then does without other
files, without the network, without other processes and their memory, and without programs:

* its root is the folder, or an empty one (chroot), where it is root's or user namespaces are free;
* Landlock bounds the files that it opens, landlock(7);
* as root's, it becomes a user of its own; all capabilities are given up;
* seccomp(2) allows the calls that readers make, and no others (`system_calls.py`).

What it needs later has to be imported before: behind a root of its own there are no modules.
"""

import ctypes
import os
import struct
import sys
import sysconfig
import tempfile
from contextlib import suppress
from pathlib import Path

from service.wire.libc import LIBC, checked
from service.wire.system_calls import bound_calls, can_be_bounded
from worker.process import die_with_parent

_PR_SET_NO_NEW_PRIVS, _PR_CAP_AMBIENT, _CLEAR_ALL = 38, 47, 4  # prctl(2)
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on every architecture
_ABI_VERSION, _PATH_BENEATH = 1, 1
_NEW_USER = 0x10000000  # CLONE_NEWUSER, unshare(2)
_CAPABILITIES_3 = 0x20080522  # the version of capset(2)
# Of the users that systemd lends to services; a container may know no others than the first 65536.
FIRST_USER, USERS = 61_184, 4_336
# Rights on files, by bit: run, write, read, list, remove a folder or a file, make a device, a
# folder, a file, a socket, a FIFO, a block device, a symbolic link, move, truncate, ioctl.
_ALL, _LIST, _READ = (1 << 13) - 1, 1 << 3, 1 << 2
_WORK = _READ | _LIST | 1 << 1 | 1 << 4 | 1 << 5 | 1 << 7 | 1 << 8  # in the folder
_MOVE, _TRUNCATE, _IOCTL = 1 << 13, 1 << 14, 1 << 15  # known since the versions 2, 3 and 5
_TCP = 0b11  # bind and connect, known since version 4
_SCOPED = 0b11  # abstract sockets of others and signals to them, known since version 6


def available() -> tuple[str, ...]:
    """Return by which means of the kernel processes can be confined here."""
    means = {
        "landlock": _landlock_version() > 0,
        "seccomp": can_be_bounded(),
    }
    return tuple(name for name, has in means.items() if has)


def confine(folder: Path | None) -> None:
    """Confine this process, for good, to a folder, if any, and to reading Python's libraries.

    Where it can have a root of its own, that is the folder, and libraries are out of reach, too.
    Without support of the kernel nothing happens; `available` returns what it supports.

    Raises
    ------
    OSError
        If the kernel supports it, but refuses.
    """
    means = available()
    if not means:
        return
    parent, is_root = os.getppid(), os.geteuid() == 0
    checked(LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    libraries = _libraries()
    if (is_root or LIBC.unshare(_NEW_USER) == 0) and _enter(folder):
        folder, libraries = folder and Path("/"), set()
        if is_root:
            _become(FIRST_USER + os.getpid() % USERS, folder)
    _drop_capabilities()
    die_with_parent(parent)  # which the kernel forgets as rights change
    if "landlock" in means:
        _restrict_files(folder, libraries)
    if "seccomp" in means:
        bound_calls()


def _enter(folder: Path | None) -> bool:
    """Make the folder the root; without one, an empty folder that is gone. Return whether it is."""
    try:
        place = Path(tempfile.mkdtemp()) if folder is None else folder
        os.chdir(place)
        if folder is None:
            place.rmdir()
        os.chroot(".")
    except OSError:  # a container may not let it
        return False
    os.chdir("/")
    tempfile.tempdir = "/"
    return True


def _become(user: int, folder: Path | None) -> None:
    """Become another user, without groups, who owns the folder; remain where there is none such."""
    with suppress(OSError):
        for place in (folder, *folder.rglob("*")) if folder else ():
            os.chown(place, user, user, follow_symlinks=False)
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)


def _drop_capabilities() -> None:
    LIBC.prctl(_PR_CAP_AMBIENT, _CLEAR_ALL, 0, 0, 0)
    header, none = struct.pack("=Ii", _CAPABILITIES_3, 0), bytes(24)
    checked(LIBC.capset(ctypes.c_char_p(header), ctypes.c_char_p(none)))


def _libraries() -> set[Path]:
    """Return the folders of Python's own modules, of installed packages and of shared libraries."""
    kinds = ("stdlib", "platstdlib", "purelib", "platlib")
    python = [Path(sysconfig.get_path(kind)) for kind in kinds]
    # Others that this environment takes packages from.
    packages = [place for place in map(Path, sys.path) if place.name.endswith("-packages")]
    shared = map(Path, ("/lib", "/lib64", "/usr/lib", "/usr/lib64"))
    return {path.resolve() for path in (*python, *packages, *shared) if path.is_dir()}


def _landlock_version() -> int:
    """Return the version of Landlock's interface; 0 or less where there is none."""
    if sys.platform != "linux":
        return 0
    return int(LIBC.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _ABI_VERSION))


def _restrict_files(folder: Path | None, libraries: set[Path]) -> None:
    version = _landlock_version()
    files = _ALL
    for since, right in ((2, _MOVE), (3, _TRUNCATE), (5, _IOCTL)):
        files |= right if version >= since else 0
    rules = struct.pack("=Q", files)
    if version >= 4:
        rules += struct.pack("=Q", _TCP)
    if version >= 6:
        rules += struct.pack("=Q", _SCOPED)
    ruleset = checked(LIBC.syscall(_CREATE_RULESET, rules, ctypes.c_size_t(len(rules)), 0))
    allowed = dict.fromkeys(libraries, _READ | _LIST | 1)
    if folder is not None:
        allowed[folder.resolve()] = _WORK | (_TRUNCATE if version >= 3 else 0)
    for path, rights in allowed.items():
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
        rule = struct.pack("=Qi", rights, place)
        checked(LIBC.syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
        os.close(place)
    checked(LIBC.syscall(_RESTRICT_SELF, ruleset, 0))
    os.close(ruleset)
