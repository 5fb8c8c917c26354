"""Finished chunks of a long job in a directory, so that an interrupted job goes on where it was."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PyTree = Any


def stored_chunk(directory: str | Path) -> int | None:
    """The chunk size of the job whose results are in the directory; None if there are none."""
    manifest = _manifest(Path(directory))
    return None if manifest is None else manifest["chunk"]


class Store:
    """Results of chunks as files, each written whole or not at all.

    Raises:
        ValueError: the directory holds the results of another job.
    """

    def __init__(self, directory: str | Path, program: str, arguments: PyTree, chunk: int) -> None:  # noqa: D107
        self._directory = Path(directory)
        self._warned = False
        digest = hashlib.sha256(program.encode())
        for leaf in jax.tree.leaves(arguments):
            if jnp.issubdtype(jnp.result_type(leaf), jax.dtypes.prng_key):
                leaf = jax.random.key_data(leaf)
            digest.update(np.ascontiguousarray(leaf).tobytes())
        manifest = {"job": digest.hexdigest(), "chunk": chunk}
        found = _manifest(self._directory)
        if found is None:
            self._write("job.json", json.dumps(manifest).encode())
        elif found != manifest:
            raise ValueError(
                f"checkpoint: {str(directory)!r} holds another job (other filters, data, key, chunk, or another jax)"
            )

    def load(self, first: int, tree: Any) -> PyTree | None:
        """The result of the chunk that begins with run ``first``, or None if it is not there, or damaged."""
        try:
            with np.load(self._directory / _name(first), allow_pickle=False) as file:
                return jax.tree.unflatten(tree, [file[str(i)] for i in range(len(file.files))])
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None

    def save(self, first: int, result: PyTree) -> None:
        """Stores a result of NumPy arrays. If that fails (a full disk), warns once: the job goes on in memory."""
        arrays = {str(i): leaf for i, leaf in enumerate(jax.tree.leaves(result))}
        self._write(_name(first), lambda file: np.savez(file, **arrays))

    def _write(self, name, content):
        temporary = None
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self._directory, suffix=".part", delete=False) as file:
                temporary = file.name
                content(file) if callable(content) else file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, self._directory / name)
        except OSError as error:
            if temporary is not None:
                Path(temporary).unlink(missing_ok=True)
            if not self._warned:
                self._warned = True
                warnings.warn(f"checkpoint: a chunk could not be stored ({error}); going on in memory", stacklevel=4)


def _name(first):
    return f"runs-{first:012d}.npz"


def _manifest(directory):
    try:
        return json.loads((directory / "job.json").read_text())
    except FileNotFoundError:
        return None
