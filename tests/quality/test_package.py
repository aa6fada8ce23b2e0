"""What a newcomer and a package index see: versions, README, portable builds."""

from __future__ import annotations

import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import pytest
from sources import CORE, PACKAGE, ROOT

import cgemit
from pages.readme import run_example

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
README = (ROOT / "README.md").read_text()
TEXT = {".py", ".pyi", ".hpp", ".cpp", ".txt", ".toml", ".md", ".cff", ".csv", ".yaml", ".json", ""}
# Written in two parts, so that this file does not hold them itself.
FORBIDDEN = ("-ffast" + "-math", "/ho" + "me/", "/wo" + "rk/", "/Us" + "ers/", "/t" + "mp/")
X86 = re.compile(r"-m(?:arch|tune|avx|sse|fma)|immintrin|__AVX|__SSE|_mm256|_mm512")


def blocks(language: str) -> list[str]:
    """Return the code blocks of README.md in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def repository_files() -> Iterator[Path]:
    """Yield our own text files."""
    folders = ("src", "tests", "docs", "notebooks", "pages", "tools", ".ci")
    for path in [*ROOT.iterdir(), *(p for folder in folders for p in (ROOT / folder).rglob("*"))]:
        hidden = "__pycache__" in path.parts or path.name == ".git"
        if path.is_file() and path.suffix in TEXT and not hidden:
            yield path


def test_versions_agree() -> None:
    (cited,) = re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert PYPROJECT["project"]["version"] == cited == cgemit.__version__


def test_licences_agree() -> None:
    (cited,) = re.findall(r"^license: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert PYPROJECT["project"]["license"] == cited == "BSD-3-Clause"
    assert "Redistribution and use in source and binary forms" in (ROOT / "LICENSE").read_text()


def test_package_is_typed() -> None:
    assert (PACKAGE / "py.typed").exists()


def test_nothing_in_the_repository_is_bound_to_a_machine() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {text}"
        for path in repository_files()
        for text in FORBIDDEN
        if text in path.read_text(encoding="utf-8")
    ]
    assert not found


def test_default_build_knows_no_instruction_set() -> None:
    sources = [ROOT / "CMakeLists.txt", ROOT / "pyproject.toml", *CORE.rglob("*.?pp")]
    found = [
        (path.name, line.strip())
        for path in sources
        for line in path.read_text().splitlines()
        if X86.search(line) and path.parent.name != "lanes"  # asks the compiler what it has
    ]
    # Libraries of their own, opened where the processor allows.
    assert [line.split(" -")[0] for _, line in found] == ["cgemit_kernels(v3 4", "cgemit_kernels(v4 8"]
    assert "immintrin" not in (CORE / "kernels" / "kernels.cpp").read_text()
    assert X86.search("target_compile_options(core PRIVATE -march=native)")


def test_readme_has_two_commands_that_install_and_run() -> None:
    commands = blocks("sh")
    assert len(commands) == 2, ".ci/run takes them from README.md"
    for command, install, program in zip(commands, (".", ".[test]"), ("cgemit study", "pytest"), strict=True):
        first, second = command.strip().split(" && ")
        assert shlex.split(first) == ["pip", "install", install]
        assert second == program


def test_links_of_the_documentation_lead_somewhere() -> None:
    pages = [path for path in repository_files() if path.suffix == ".md"]
    broken = [
        f"{page.relative_to(ROOT)}: {link}"
        for page in pages
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
        if not link.startswith("http") and not (page.parent / link).exists()
    ]
    assert pages
    assert not broken


def test_every_page_is_in_the_contents_of_the_site() -> None:
    contents = ROOT / "docs" / "site" / "contents.md"
    lines = [line for line in contents.read_text().splitlines() if line and not line.startswith((":", "```"))]
    listed = {path for line in lines for path in ROOT.glob(line + ("" if line.endswith("*") else ".*"))}
    pages = {path for path in (ROOT / "docs").rglob("*.md") if path != contents}
    assert pages
    assert not pages - listed
    assert all(list(ROOT.glob(line if line.endswith("*") else f"{line}.*")) for line in lines)


@pytest.mark.slow
def test_readme_example_prints_its_block(tmp_path: Path) -> None:
    mpl.use("agg")
    printed, _ = run_example(*blocks("python"), tmp_path)
    assert blocks("text") == [printed]
    assert (tmp_path / "momentum.png").stat().st_size > 10_000


def test_check_script_is_bash_and_parses() -> None:
    script = ROOT / ".ci" / "run"
    if not script.exists():
        pytest.skip("the source distribution has no .ci")
    assert script.read_text().startswith("#!/usr/bin/env bash\n")
    assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
