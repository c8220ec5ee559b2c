"""File formats of recordings, one module each; the registry imports the modules of this folder."""

import glob
from collections.abc import Sequence
from pathlib import Path

from frictionzoo.core.errors import LogError
from frictionzoo.data.formats.base import Format, format_names, get_format, parsing, register_format
from frictionzoo.data.recording import Table

CONVERSIONS = {
    **dict.fromkeys((".xlsx", ".xls", ".xlsm", ".ods", ".numbers"), "a spreadsheet; save its sheet as CSV (UTF-8)"),
    **dict.fromkeys(
        (".pkl", ".pickle", ".joblib"),
        "a pickle, which could run any program when read; in Python: numpy.savez('a.npz', time=time, ...)",
    ),
    **dict.fromkeys((".h5", ".hdf5"), "HDF5; in Python: numpy.savez('a.npz', time=file['time'][:], ...)"),
    ".npy": "an array without names; in Python: numpy.savez('a.npz', time=array[:, 0], qpos=array[:, 1], ...)",
    ".bag": "a recording of ROS 1; convert it by `rosbags-convert --src a.bag --dst bag`",
}
"""What files of other formats are, and their conversion, by suffix."""
__all__ = ["Format", "find_files", "format_names", "get_format", "read_tables", "register_format"]


def find_files(names: Sequence[str], folder: str | None, source: str | None) -> list[str]:
    """Find the named files, each once, in the given order; sort files of a glob or folder by name.

    Args:
        names: Paths of files or folders, or globs, in which `**` means any depth.
        folder: Folder of relative paths; None for the working directory.
        source: Where to obtain files that the package does not contain; None for a user's files.

    Raises:
        LogError: A path matches no file.
    """
    obtain = "set FRICTIONZOO_DATA or data.folder to the folder that holds {} (from {})".format
    if source is not None and folder is None:
        raise LogError(f"data.folder=null: the recordings are not part of the package; {obtain(names[0], source)}")
    all_files = []
    for name in names:
        path = Path(folder or "").expanduser() / Path(name).expanduser()
        files = _expand(path)
        if not files:
            problem = "no file in this folder" if path.is_dir() else "no such file"
            looked = f" (looked from {Path.cwd()}); check the path"
            raise LogError(f"{path}: {problem}{looked if source is None else f'; {obtain(name, source)}'}")
        all_files += map(str, sorted(files))
    return list(dict.fromkeys(all_files))


def _expand(path: Path) -> list[Path]:
    if path.is_dir() and not any(get_format(name).claims(path) for name in format_names()):
        return [inner for inner in path.iterdir() if inner.is_file() and not inner.name.startswith(".")]
    if path.exists():
        return [path]
    return [Path(match) for match in glob.glob(str(path), recursive=True) if Path(match).is_file()]


def read_tables(path: str, format: str) -> list[Table]:
    """Read the recordings at a path (file, folder or archive); format `auto` recognises it from name and contents.

    Raises:
        LogError: The path cannot be read, is empty or has no known format.
        ConfigError: The format is not registered.
    """
    place = Path(path).expanduser()
    with parsing(path, "a recording"):
        if not place.exists():
            raise LogError(f"{path}: no such file (looked from {Path.cwd()}); check data.train and data.test")
        reader = _recognise(place) if format == "auto" else get_format(format)
        tables = reader.read(place)
        if not any(table.columns or table.refused for table in tables):
            raise LogError(f"{path}: no columns, expected a recording as {reader.name}")
        return tables


def _recognise(path: Path) -> Format:
    """Recognise a format by a path's name or a folder's contents; without a suffix, by a file's first bytes."""
    formats = [get_format(name) for name in format_names()]
    head = b""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(128)
    by_name = [candidate for candidate in formats if candidate.claims(path)]
    by_content = [candidate.name for candidate in formats if head.startswith(candidate.magic)]
    if by_name and (not by_content or any(candidate.name in by_content for candidate in by_name)):
        return by_name[0]
    if len(by_content) == 1 and not path.suffix:
        return get_format(by_content[0])
    if path.suffix.lower() in CONVERSIONS:
        raise LogError(f"{path}: {CONVERSIONS[path.suffix.lower()]}")
    description = "a folder" if path.is_dir() else f"suffix {path.suffix or 'none'}"
    if by_content:
        contents = " or ".join(by_content)
        raise LogError(
            f"{path}: {description}, but its first bytes are those of {contents}; rename it or set "
            f"data.format={contents}"
        )
    raise LogError(f"{path}: {description} of no known format; set data.format to one of {', '.join(format_names())}")
