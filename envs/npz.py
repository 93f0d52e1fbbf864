"""Arrays in a file whose bytes depend on them alone, so that it can be made again and compared."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from envs.outputs import replacing


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes what `np.load` reads, the arrays in the order of their names; whole or not at all.

    Makes the directory of the file.

    Raises:
        ValueError: the file cannot be written (two lines: cause, cure).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_STORED) as archive:
        for key, array in sorted(arrays.items()):
            # np.savez stamps the time of day on each member; a fixed date keeps the file equal.
            entry = zipfile.ZipInfo(f"{key}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            with archive.open(entry, "w") as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"))
