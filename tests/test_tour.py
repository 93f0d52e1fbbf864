"""The notebook docs/tour.ipynb runs from its first cell to its last, and shows what it says."""

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tour.ipynb"


@pytest.fixture(scope="module")
def cells():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    place = {"metadata": {"path": str(NOTEBOOK.parent)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=place).execute()
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(cells, kind):
    return [
        out["data"][kind] for cell in cells for out in cell.outputs if kind in out.get("data", {})
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Jupyter's own
def test_the_tour_runs(cells):
    printed = "".join(out.get("text", "") for cell in cells for out in cell.outputs)
    rows = [line.split() for line in printed.splitlines() if line.startswith("window-close  ")]
    success = {int(k): float(rate) for _, k, rate, *_ in rows}
    assert success[20] >= 0.8 > success[0], "it has adapted"
    assert len(outputs(cells, "image/png")) == 3, "curves, success by episodes, the film's sheet"
    assert "video/mp4" in "".join(outputs(cells, "text/html"))


def test_what_is_committed_was_run():
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert NOTEBOOK.stat().st_size < 2e6
