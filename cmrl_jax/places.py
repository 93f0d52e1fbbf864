"""Where the package's own files lie."""

from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
DATA = PACKAGE / "data"
ROOT = PACKAGE.parent  # of a source tree; site-packages of an installed wheel
