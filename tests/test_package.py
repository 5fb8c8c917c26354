"""The wheel: what is in it, and that it works in an environment with nothing but what it asks for."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import jaxfilt

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.xdist_group("package")  # one environment for all


def run(*command: object, where: Path, ok: bool = True) -> subprocess.CompletedProcess[str]:
    """Runs a command far from the checkout: no paths of ours, and no flags that speed compiling up."""
    env = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run([str(part) for part in command], cwd=where, env=env, capture_output=True, text=True)
    assert not ok or done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """``(wheel, sdist)``."""
    dist = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", dist, ROOT, where=dist)
    (wheel,), (sdist,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture(scope="module")
def python(built, tmp_path_factory) -> Path:
    """The interpreter of a fresh environment with the wheel and what it needs."""
    home = tmp_path_factory.mktemp("fresh")
    run(sys.executable, "-m", "venv", home / "env", where=home)
    python = home / "env" / ("Scripts" if os.name == "nt" else "bin") / "python"
    options = ("--quiet", "--no-compile", "--disable-pip-version-check", "-c", ROOT / "requirements.lock")
    run(python, "-m", "pip", "install", *options, built[0], where=home)
    return python


def test_wheel_and_source_archive_hold_the_package_and_nothing_else(built):
    wheel, sdist = built
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = archive.read(next(n for n in names if n.endswith("METADATA"))).decode()
        entry_points = archive.read(next(n for n in names if n.endswith("entry_points.txt"))).decode()
    assert {name.split("/")[0] for name in names} == {"jaxfilt", f"jaxfilt-{jaxfilt.__version__}.dist-info"}
    assert {"jaxfilt/py.typed", "jaxfilt/__main__.py", "jaxfilt/cli/read.py"} <= set(names)
    package = {p.relative_to(ROOT).as_posix() for p in (ROOT / "jaxfilt").rglob("*.py")}
    assert package <= set(names)
    assert not [name for name in names if name.endswith((".csv", ".npz", ".pyc"))]
    with tarfile.open(sdist) as archive:
        tops = {name.split("/")[1] for name in archive.getnames() if "/" in name}
    assert tops == {"jaxfilt", "pyproject.toml", "README.md", "LICENSE", "NOTICE", "PKG-INFO", ".gitignore"}
    assert "jaxfilt = jaxfilt.__main__:main" in entry_points
    assert Parser().parsestr(metadata)["Version"] == jaxfilt.__version__
    needed = {
        re.split(r"[<>=\s;]", x)[0]
        for x in Parser().parsestr(metadata).get_all("Requires-Dist", [])
        if "extra" not in x
    }
    assert needed == {"jax", "jaxlib", "numpy", "optax", "chex"}


def test_the_version_is_the_same_in_all_places():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.MULTILINE)[1] == jaxfilt.__version__  # pyright: ignore[reportOptionalSubscript]
    assert f"\n## {jaxfilt.__version__}\n" in changelog


def test_a_fresh_environment_has_only_what_is_mandated_and_runs_the_readme(python, tmp_path):
    listed = run(python, "-m", "pip", "list", "--format=freeze", where=tmp_path).stdout.lower()
    installed = {line.split("==")[0] for line in listed.splitlines()}
    assert {"jaxfilt", "jax", "optax", "chex"} <= installed
    assert not installed & {"matplotlib", "pandas", "pymoo", "tqdm", "plotly", "xarray", "pytest"}
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "readme.py").write_text(code + EXTRAS, encoding="utf-8")
    (tmp_path / "x.csv").write_text("t,x,y\n0,0,0\n1,1,1\n", encoding="utf-8")
    said = run(python, "readme.py", where=tmp_path).stdout.splitlines()
    assert said[0].startswith(str(python.parents[1]))  # not the checkout
    assert said[1:] == ["True", '"jaxfilt[plot]"', '"jaxfilt[tune]"', '"jaxfilt[progress]"', '"jaxfilt[data]"']
    refused = run(python.parent / "jaxfilt", "track", "x.csv", where=tmp_path, ok=False)
    assert refused.returncode == 2
    assert refused.stderr.splitlines() == ['jaxfilt: the command line needs pandas: pip install "jaxfilt[cli]"']


# Runs after the README's lines: each missing extra says how to install it.
EXTRAS = """
import re
from pathlib import Path

print(jf.__file__)
print((Path(jf.__file__).parent / "py.typed").is_file())


def square(params, data):
    return params["q"] ** 2


space = {"q": jf.tune.positive(1.0)}
for attempt in (
    lambda: jf.plots.track(out),
    lambda: jf.tune.genetic(square, space, key=jax.random.key(0)),
    lambda: jf.tune.gradient(square, space, key=jax.random.key(0), progress=True),
    lambda: jf.frames.to_frame(out),
):
    try:
        attempt()
    except ImportError as error:
        print(re.search("pip install (.*)", str(error))[1])
"""
