"""Build the documentation's site, warnings as errors: python docs/make_site.py FOLDER (extra [docs])."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def main(folder: str) -> None:
    """Build the site in a folder, with the executed notebooks beside their pages as .ipynb; each draws something."""
    target = Path(folder).resolve()
    with tempfile.TemporaryDirectory() as temporary:
        built = Path(temporary) / "html"
        command = ["-m", "sphinx", "-q", "-E", "-W", "-j", "auto", "-c", "docs", "-d", f"{temporary}/doctrees"]
        # Notebooks draw by Jupyter's own backend: with another one, such as agg of tests, their pictures are not kept.
        environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
        subprocess.run([sys.executable, *command, ".", str(built)], cwd=ROOT, check=True, env=environment)
        for page in built.rglob("*.html"):  # formulas work without a network; widgets of notebooks do not
            remote = re.search(r'<script[^>]* src="https?:', page.read_text(encoding="utf-8"))
            if remote and "notebooks" not in page.parts:
                sys.exit(f"{page.name}: loads a script from elsewhere")
        for notebook in (Path(temporary) / "jupyter_execute" / "notebooks").glob("*.ipynb"):
            if '"image/png"' not in notebook.read_text(encoding="utf-8"):
                sys.exit(f"{notebook.stem}: no picture")
            shutil.copy(notebook, built / "notebooks")
        shutil.copytree(built, target, dirs_exist_ok=True)
    print(f"{len(list(target.rglob('*.html')))} pages: {target / 'index.html'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
