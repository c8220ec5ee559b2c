"""PyTorch files of named tensors, read without unpickling other objects."""

import io
import pickle
from collections.abc import Mapping
from typing import ClassVar

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, check_unpacked, parsing, register_format, tabulate, unzip
from frictionzoo.data.recording import Table

EXPECTED = "tensors by name, as in torch.save({'time': time, 'qpos': qpos, 'ctrl': ctrl}, FILE)"


@register_format("pt")
class Pt(Format):
    """PyTorch file with a dictionary of tensors: a vector is a column, a matrix a column per signal."""

    suffixes: ClassVar[tuple[str, ...]] = (".pt", ".pth")
    magic: ClassVar[tuple[bytes, ...]] = (b"PK\x03\x04",)

    def parse(self, name: str, content: bytes) -> Table:
        """Return the table of a file's tensors."""
        import torch  # late: no other format needs it

        with parsing(name, "a file of torch.save"):
            for _ in unzip(name, content, ""):  # verifies sizes and checksums
                pass
            try:
                stored = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
            except pickle.UnpicklingError:
                reason = "which could run any program when read"
                raise LogError(f"{name}: holds Python objects, {reason}; expected {EXPECTED}") from None
            if not isinstance(stored, Mapping):
                raise LogError(f"{name}: holds one {type(stored).__name__}, expected {EXPECTED}")
            values = {str(key): value for key, value in stored.items()}
            tensors = {key: value for key, value in values.items() if isinstance(value, torch.Tensor)}
            # An expanded tensor stores one number for many.
            check_unpacked(name, sum(8 * tensor.numel() for tensor in tensors.values()))
            real = {key: tensor.double() if tensor.is_floating_point() else tensor for key, tensor in tensors.items()}
            return tabulate(name, values | {key: tensor.detach().numpy() for key, tensor in real.items()})
