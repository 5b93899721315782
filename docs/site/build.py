"""`make docs`: the pages as HTML in build/site.

MkDocs wants all pages in one folder that holds neither its configuration nor its output. So pages,
figures and the code that pages link to are copied first, in the places that they have here: links
are the same on the web, on a disk and in a checkout.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("app", "benchmarks", "clients", "docs", "migrations", "models", "tests")
SHOWN = (".md", ".svg", ".png", ".gif", ".webp", ".py", ".c", ".h", ".json", ".jsonl")


def copy_pages(pages: Path) -> None:
    """Copy every page with all that it may show or link to."""
    shutil.rmtree(pages, ignore_errors=True)
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    for path in [ROOT / "README.md", *found]:
        if path.suffix in SHOWN and path.is_file():
            copy = pages / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)


def write_configuration(folder: Path) -> Path:
    """Copy MkDocs's configuration beside the pages, with what it calls."""
    for name in ("mkdocs.yml", "mathematics.py"):
        shutil.copyfile(Path(__file__).with_name(name), folder / name)
    return folder / "mkdocs.yml"


def main() -> int:
    """Build the site in a folder; a link or an anchor that leads nowhere is an error."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build"
    copy_pages(folder / "pages")
    configuration = write_configuration(folder)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-f", configuration]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, env=env, check=False)  # noqa: S603 - nobody else's words
    if built.returncode == 0:
        sys.stdout.write(f"{folder / 'site' / 'index.html'}\n")
    return built.returncode


if __name__ == "__main__":
    sys.exit(main())
