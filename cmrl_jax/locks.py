"""The lock of an open file, by which one process at a time writes to what it stands for.

The system gives it back when the file is closed or the process ends, however it ends.
"""

from __future__ import annotations

import errno
import fcntl
import sys
from typing import IO, Any

WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)


def hold(file: IO[Any], name: object) -> bool:
    """Takes the lock of an open file; False where another process holds it.

    On a file system without locks: True, after a line of warning that names what is not guarded.

    Raises:
        OSError: the system refuses for another reason.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise
        cause = f"the file system of {name} has no locks ({error.strerror})"
        print(f"warning: {cause}: do not let a second process write to it", file=sys.stderr)
    return True
