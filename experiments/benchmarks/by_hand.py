"""The C loop of ``ref.c``, built with gcc into a temporary folder and called by ctypes."""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.cases import Data, Problem

SOURCE = Path(__file__).with_name("ref.c")
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-fPIC", "-Wno-psabi")
_folder: Any = None  # removed when the process ends
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # waiting threads would take the cores from other work


@functools.cache
def library(n: int, m: int, dtype: str) -> ctypes.CDLL:
    """The compiled loop for these sizes.

    Raises:
        ImportError: no gcc, or it cannot build it; what is missing is left out like a package.
    """
    global _folder
    gcc = shutil.which("gcc")
    if gcc is None:
        raise ImportError("no gcc")
    _folder = _folder or tempfile.TemporaryDirectory(prefix="benchmarks")
    path = Path(_folder.name) / f"ref_{n}_{m}_{dtype}.so"
    real, suffix = {"float64": ("double", ""), "float32": ("float", "f")}[dtype]
    macros = {"N": n, "M": m, "REAL": real, "SQRT": f"sqrt{suffix}", "LOG": f"log{suffix}"}
    compiled = path.with_suffix(".o")
    # Linked without -ffast-math, which would make the whole process take subnormal numbers for 0.
    for command in (
        [gcc, *FLAGS, *(f"-D{key}={value}" for key, value in macros.items()), "-c", str(SOURCE), "-o", str(compiled)],
        [gcc, "-shared", "-fopenmp", str(compiled), "-o", str(path), "-lm"],
    ):
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        if built.returncode:
            raise ImportError(f"gcc failed: {built.stderr.strip().splitlines()[0]}")
    return ctypes.CDLL(str(path))


def prepare(p: Problem, data: Data, history: int, threads: int) -> Callable[[], tuple[np.ndarray, ...]]:
    """A call that filters a batch; the data are laid out, and the results allocated, beforehand.

    Args:
        p: the problem.
        data: its data.
        history: 0 gives the log-likelihoods (B,), 1 also means (T, n, B) and lower triangles (T, n (n + 1) / 2, B), 2
            means and covariances (T, n n, B).
        threads: of OpenMP.
    """
    dtype = p.F.dtype
    filter_ = library(p.n, p.m, dtype.name).filter
    runs, steps = data.ys.shape[:2]
    lanes = 64 // dtype.itemsize
    padded = -(-runs // lanes) * lanes
    index = np.minimum(np.arange(padded), runs - 1)
    rows = np.tril_indices(p.m)
    R = p.R0[rows][:, None] * np.exp(data.log_r)[index]
    ys = _aligned((steps, p.m, padded), dtype)
    ys[:] = np.moveaxis(data.ys, 0, -1)[..., index]
    count = {0: 0, 1: p.n * (p.n + 1) // 2, 2: p.n * p.n}[history]
    arrays = [*(np.ascontiguousarray(x) for x in (p.F, p.H, p.Q, p.m0, p.P0)), _copied(R.astype(dtype)), ys,
              _aligned((padded,), dtype), _aligned((steps, p.n if history else 0, padded), dtype),
              _aligned((steps, count, padded), dtype)]  # fmt: skip
    pointers = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
    threads = max(1, min(threads, padded // (4 * lanes)))  # a thread needs some blocks
    scalars = (ctypes.c_long(padded), ctypes.c_long(steps), ctypes.c_int(threads), ctypes.c_int(history))

    def call():
        filter_(*scalars, *pointers)
        return (arrays[7][:runs],) if history == 0 else (arrays[8][..., :runs], arrays[9][..., :runs])

    return call


def _aligned(shape, dtype):
    size = int(np.prod(shape)) * dtype.itemsize
    buffer = np.zeros(size + 64, np.uint8)
    start = -buffer.ctypes.data % 64
    return buffer[start : start + size].view(dtype).reshape(shape)


def _copied(x):
    out = _aligned(x.shape, x.dtype)
    out[:] = x
    return out
