"""Runs examples/tour.ipynb anew and keeps its outputs, and README's picture: `python tests/tour.py`.

`--check` writes nothing, and fails where a cell prints anything else than the notebook shows.
"""

import base64
import os
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "examples/tour.ipynb"
PICTURE = ROOT / ".github/pictures/answers.png"
SECONDS = 600  # for a cell, on a machine that does other things, too
PICTURED = "readme"  # the tag of the cell whose picture README shows


def run() -> Any:
    """The notebook, executed in a kernel of this interpreter, from a clean start."""
    import nbformat
    from jupyter_client.manager import AsyncKernelManager
    from nbclient import NotebookClient

    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(ROOT), str(ROOT / "store"), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    kernel = AsyncKernelManager(kernel_name="python3", transport="ipc")  # sockets that nobody else can read
    NotebookClient(notebook, km=kernel, timeout=SECONDS, record_timing=False).execute()
    notebook.metadata = {"language_info": {"name": "python"}, "kernelspec": notebook.metadata["kernelspec"]}
    return notebook


def texts(notebook: Any) -> list[str]:
    """What its cells print, and what each ends with, one cell after another; no pictures."""
    return ["".join(_text(output) for output in cell.get("outputs", ())) for cell in notebook.cells]


def _text(output: Any) -> str:
    if output.output_type == "stream":
        return str(output.text)
    return "" if "image/png" in output.data else str(output.data["text/plain"])


def picture(notebook: Any) -> bytes:
    """The picture of the cell that README shows."""
    (cell,) = [cell for cell in notebook.cells if PICTURED in cell.metadata.get("tags", ())]
    (png,) = [output.data["image/png"] for output in cell.outputs if "image/png" in output.get("data", ())]
    return base64.b64decode(png)


def main() -> None:
    """Run, and keep or compare."""
    import nbformat

    shown, done = nbformat.read(NOTEBOOK, as_version=4), run()
    if "--check" in sys.argv:
        for cell, before, now in zip(done.cells, texts(shown), texts(done), strict=True):
            if before != now:
                raise SystemExit(f"{cell.source}\nshows\n{before}\nand gives\n{now}\nrun python tests/tour.py")
        return
    nbformat.write(done, NOTEBOOK)
    PICTURE.parent.mkdir(exist_ok=True)
    PICTURE.write_bytes(picture(done))
    print(*(path.relative_to(ROOT) for path in (NOTEBOOK, PICTURE)))


if __name__ == "__main__":
    main()
