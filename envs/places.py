"""Where the package's own files lie."""

from pathlib import Path

DATA = Path(__file__).resolve().parent / "data"
