"""Build the sdist and the wheel, install the wheel into a new environment, and use it from there.

Run by ``make package`` and CI; no pytest test, because it builds from the whole checkout.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def _missing(wheel: Path) -> list[str]:
    """Return source files of the listed packages that the wheel lacks."""
    tables = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = [
        f"{package.replace('.', '/')}/{file.name}"
        for package, folder in tables["package-dir"].items()
        for file in (ROOT / folder).glob("*.py")
    ]
    wanted += [
        f"marcha/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "recording" / "msg").rglob("*.msg")
    ]
    wanted += [
        f"marcha/{p.relative_to(ROOT).as_posix()}" for p in (ROOT / "study" / "presets").rglob("*.toml")
    ]
    return sorted(set(wanted) - names)


def _untyped(site: Path, folder: Path) -> str:
    """Return what a type checker says of the installed packages that it does not take for typed (PEP 561)."""
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"][
        "packages"
    ]
    (folder / "use.py").write_text(
        "# pyright: reportMissingTypeStubs=error\n" + "".join(f"import {name}\n" for name in packages)
    )
    (folder / "pyrightconfig.json").write_text("{}")
    done = subprocess.run(
        [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "use.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    return "" if done.returncode == 0 else done.stdout + done.stderr


def main() -> int:
    """Return 0 when the wheel is whole and its command answers from outside the checkout."""
    with tempfile.TemporaryDirectory() as tmp:
        folder = Path(tmp)
        subprocess.run(
            [sys.executable, "-m", "build", "--outdir", str(folder / "dist"), str(ROOT)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        (wheel,) = (folder / "dist").glob("*.whl")
        if missing := _missing(wheel):
            print(f"{wheel.name} lacks: {', '.join(missing)}", file=sys.stderr)
            return 1
        # Dependencies come from the running environment; marcha itself only from the wheel.
        target = folder / "site"
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(target), str(wheel)]
        subprocess.run(pip, check=True)
        code = (
            "import sys; sys.path.insert(0, sys.argv[1])\n"
            "sys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in getattr(f, '__module__', '')"
            " and 'editable' not in getattr(f, '__name__', '').lower()]\n"
            "import marcha.cli, marcha.recording as mr, marcha.algorithms as ma\n"
            "assert marcha.cli.__file__.startswith(sys.argv[1]), marcha.cli.__file__\n"
            "assert mr.SCHEMAS and ma.available()\n"
            "marcha.cli.main(['estimators'])\n"
        )
        subprocess.run(
            [sys.executable, "-c", code, str(target)], cwd=folder, check=True, stdout=subprocess.DEVNULL
        )
        if said := _untyped(target, folder):
            print(f"{wheel.name}: a type checker does not take it for typed\n{said}", file=sys.stderr)
            return 1
    print(f"{wheel.name}: whole, typed, and it runs from outside the checkout")
    return 0


if __name__ == "__main__":
    sys.exit(main())
