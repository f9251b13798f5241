"""Every example of README and docs runs, in order, and prints what the page says.

```python blocks of a page share their names; a ```text block after one is what it prints. ```console blocks run their
``$`` lines in a shell (exit status 0 unless a line ``# exit status N`` follows). Shown lines must appear in the output
in order, ``...`` stands for anything; numbers with a decimal point need only be near, since they differ a little from
machine to machine.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"-?\d+\.\d*(?:e[-+]?\d+)?")
NEAR = 0.05


def matches(shown: str, printed: str) -> bool:
    """Whether a printed line is what the page shows, numbers taken loosely."""
    anything = shown.replace("...", "\0")
    numbers = [float(n) for n in NUMBER.findall(anything)]
    words = [re.escape(w) for w in NUMBER.split(anything)]
    pattern = rf"\s*({NUMBER.pattern})".join(words).replace("\0", ".*")
    hit = re.fullmatch(re.sub(r"(\\ )+", r"\\s+", pattern), printed.rstrip())
    return hit is not None and all(
        abs(float(got) - want) <= NEAR * max(abs(want), 0.1) for got, want in zip(hit.groups(), numbers)
    )


def check_output(shown: str, printed: str) -> None:
    """The shown lines are in the printed ones, in order; without ``...`` between them nothing else is."""
    lines, at, free = printed.rstrip().splitlines(), 0, False
    for line in shown.rstrip().splitlines():
        if line == "...":
            free = True
            continue
        rest = range(at, len(lines)) if free else range(at, min(at + 1, len(lines)))
        hit = next((k for k in rest if matches(line, lines[k])), None)
        assert hit is not None, f"not printed: {line!r}; printed was:\n" + "\n".join(lines[at:])
        at, free = hit + 1, False
    assert free or at == len(lines), "the page leaves out:\n" + "\n".join(lines[at:])


def run_console(text: str, folder: Path) -> None:
    env = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, shown = part.partition("\n")
        status = re.search(r"^# exit status (\d+)\n", shown, re.MULTILINE)
        shown = shown.replace(status[0], "") if status else shown
        done = subprocess.run(command, shell=True, cwd=folder, env=env, capture_output=True, text=True, timeout=120)
        assert done.returncode == int(status[1] if status else 0), done.stderr
        check_output(shown, done.stdout + done.stderr)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_examples_run_and_print_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    printed = None
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    assert blocks or page.name not in ("README.md", "getting-started.md")
    for language, text in blocks:
        if language == "python":
            output = io.StringIO()
            with contextlib.redirect_stdout(output):
                exec(compile(text, str(page), "exec"), names)
            printed = output.getvalue()
        elif language == "console":
            run_console(text, tmp_path)
        elif language == "text":
            assert printed is not None, "a text block that follows no python block"
            check_output(text, printed)


def test_the_matching_can_fail():
    check_output("a 1.00 b\n...\nend\n", "a 1.02 b\nx\ny\nend\n")
    for shown in ("a 2.00 b\n...\nend", "a 1.00 c\n...\nend", "a 1.00 b\nend", "a 1.00 b\nx\ny", "...\nx\na 1.00 b"):
        with pytest.raises(AssertionError):
            check_output(shown, "a 1.02 b\nx\ny\nend\n")


def test_the_two_commands_of_the_readme_are_those_that_ci_runs():
    readme, ci = (ROOT / "README.md").read_text(), (ROOT / ".ci" / "run").read_text()
    assert "\npip install . && margcal demo\n" in readme
    assert '\npip install -e ".[dev]" && pytest\n' in readme
    assert 'pip install -q -e ".[dev]"' in ci and "\npytest " in ci and "\nmargcal demo " in ci


def test_links_between_pages_lead_somewhere():
    for page in [*PAGES, ROOT / "ARCHITECTURE.md", ROOT / "CHANGELOG.md", ROOT / "benchmarks" / "README.md"]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_verbs_in_the_readme_are_those_that_there_are():
    from margcal.apps.cli import cli

    shown = re.findall(r"^\| `margcal (\w+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert shown == list(cli.commands)


def test_architecture_names_every_module_and_none_that_is_not_there():
    """Modules of a folder within a room, such as `papers/`, need not be named one by one; the folder does."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w*]+\.py|\w+/)`", text))
    house = ROOT / "src" / "margcal"
    rooms = [p for p in house.iterdir() if (p / "__init__.py").exists()]
    parts = {p.name for room in rooms for p in room.glob("*.py")} - {"__init__.py"}
    parts |= {f"{p.name}/" for room in rooms for p in room.iterdir() if p.is_dir() and p.name != "__pycache__"}
    forgotten = sorted(n for n in parts if not any(fnmatch(n, pattern) for pattern in named))
    assert not forgotten, f"ARCHITECTURE.md says nothing of {', '.join(forgotten)}"
    there = parts | {p.name for folder in ("tests", "benchmarks") for p in (ROOT / folder).glob("*.py")}
    there |= {p.name for room in rooms for p in room.rglob("*.py")}
    there |= {f"{p.name}/" for p in (*ROOT.iterdir(), *house.iterdir()) if p.is_dir()}
    gone = sorted(pattern for pattern in named if not any(fnmatch(n, pattern) for n in there))
    assert not gone, f"ARCHITECTURE.md names {', '.join(gone)}"
