"""Disk cache of compiled machine code, in the user's own cache folder.

Compiling takes a fifth of a short diagnosis. A file holds the object code of one function; its name is the hash of
everything that the code depends on. The cache is not read from recordings, car files or run folders.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import platformdirs

MAX_FILES = 2000
"""Number of files from which the older half is removed; 20 kB each."""
_SUFFIX = ".object"
_HASH_BYTES = 32


def cache_folder() -> Path:
    """The folder of the files."""
    return platformdirs.user_cache_path("carlab", appauthor=False) / "machine-code"


def cached_object_code(key: tuple[str, ...], compile_code: Callable[[], bytes]) -> bytes:
    """Object code from the cache, or compiled and written to the cache.

    A damaged file is replaced. A folder that cannot be read or written, or that other users can write to, is not used.

    Args:
        key: everything that the code depends on: source, processor, version of the compiler.
        compile_code: returns the object code.
    """
    folder = cache_folder()
    if not _is_private(folder):
        return compile_code()
    path = folder / (_hash("\0".join(key).encode()).hex() + _SUFFIX)
    code = _read(path)
    if code is None:
        code = compile_code()
        with contextlib.suppress(OSError):
            _write(path, code)
    return code


def _is_private(folder: Path) -> bool:
    """Whether no other user can write to a folder; a missing folder is created for this user alone."""
    try:
        status = folder.stat()
    except OSError:
        return True
    return not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o022)


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


def _read(path: Path) -> bytes | None:
    """The code of a file; None if the file is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, code = content[:_HASH_BYTES], content[_HASH_BYTES:]
    return code if code and _hash(code) == digest else None


def _write(path: Path, code: bytes) -> None:
    """Write a file atomically."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    _remove_older_half(path.parent)
    handle, temporary = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(_hash(code) + code)
        os.replace(temporary, path)
    except OSError:
        Path(temporary).unlink(missing_ok=True)
        raise


def _remove_older_half(folder: Path) -> None:
    files = list(folder.glob(f"*{_SUFFIX}"))
    if len(files) >= MAX_FILES:
        for path in sorted(files, key=lambda p: p.stat().st_mtime)[: len(files) // 2]:
            path.unlink(missing_ok=True)
