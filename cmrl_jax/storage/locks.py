"""The lock of an open file, by which one process at a time writes to what it stands for.

The system gives it back when the file is closed or the process ends, however it ends.
"""

from __future__ import annotations

import errno
import fcntl
from typing import IO, Any

from cmrl_jax.streams import to_stderr

NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)


def lock(file: IO[Any], what: str) -> None:
    """Locks a file until it is closed; only warns where the file system has no locks.

    Args:
        what: is kept from other processes, in words.

    Raises:
        BlockingIOError: another process holds the lock.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        to_stderr(
            f"warning: {what} is on a file system without locks ({error.strerror}): "
            "take care that no other process writes to it"
        )
