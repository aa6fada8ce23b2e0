"""Build the documentation's site, warnings as errors: python docs/make_site.py FOLDER (extra [docs])."""

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
        subprocess.run([sys.executable, *command, ".", str(built)], cwd=ROOT, check=True)
        for notebook in (Path(temporary) / "jupyter_execute" / "notebooks").glob("*.ipynb"):
            if '"image/png"' not in notebook.read_text(encoding="utf-8"):
                sys.exit(f"{notebook.stem}: no picture")
            shutil.copy(notebook, built / "notebooks")
        shutil.copytree(built, target, dirs_exist_ok=True)
    print(f"{len(list(target.rglob('*.html')))} pages: {target / 'index.html'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
