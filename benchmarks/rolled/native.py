"""C++ programs of this folder: compiled where they run, exchanging 64-bit numbers over pipes."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def compile_program(source: str, program: Path, flags: Sequence[str | Path]) -> None:
    """Compile a source file of this folder with g++ and these flags."""
    command = ["g++", "-std=c++20", Path(__file__).parent / source, "-o", program, *flags]
    subprocess.run(command, check=True)


class Running:
    """Running program. If it ends early, this process exits with its status.

    Attributes:
        version: First line of its output.
    """

    def __init__(self, command: Sequence[str | Path]) -> None:
        """Start the program."""
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._told, self._said = self._process.stdin, self._process.stdout
        self.version = self._said.readline().decode().strip()
        if not self.version:
            sys.exit(self._process.wait() or 1)

    def tell(self, numbers: np.ndarray) -> None:
        """Send numbers to the program."""
        self._told.write(numbers.astype(float).tobytes())
        self._told.flush()

    def ask(self, numbers: np.ndarray, *shape: int) -> np.ndarray:
        """Send numbers and return the answer, of this shape."""
        self.tell(numbers)
        size = 8 * int(np.prod(shape))
        said = self._said.read(size)
        if len(said) < size:
            sys.exit(self._process.wait() or 1)
        return np.frombuffer(said).reshape(shape)
