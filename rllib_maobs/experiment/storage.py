"""Results at a URL, such as s3://bucket/results/run: what many machines can reach, and any of them can resume."""

from argparse import Namespace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from urllib.parse import urlsplit

from pyarrow import fs

from rllib_maobs.experiment.claim import LOCK

_TRIED = ".writable"


def is_url(place: object) -> bool:
    """Return whether results go to a URL instead of a folder."""
    return "://" in str(place)


class Storage:
    """A results folder at a URL, and a temporary folder that holds all of it but the checkpoints.

    Ray Tune writes to the URL itself. What this package reads and writes beside it, it does in the folder.

    Attributes:
        url: As given, without a slash at the end.
        parent: URL of the folder that holds the results folder.
        folder: The temporary folder, which has the same name.

    Args:
        url: One that `pyarrow.fs.FileSystem.from_uri` takes, as Ray Tune does.

    Raises:
        ValueError: If it is no such URL, or cannot be written.
    """

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        path = PurePosixPath(parts.path.rstrip("/"))
        if not path.name:
            raise ValueError(f"--results-dir: {url} names no folder; legal is, say, {url.rstrip('/')}/results/my-run")
        self.url = parts._replace(path=str(path)).geturl()
        self.parent = parts._replace(path=str(path.parent)).geturl()
        try:
            self._files, self._root = fs.FileSystem.from_uri(self.url)
        except Exception as error:  # of pyarrow's, of whatever it calls, and of packages that are not installed
            raise ValueError(
                f"--results-dir: {url} is no place for results ({_line(error)}); legal are a folder, and URLs that "
                f"pyarrow knows: s3://, gs://, abfs://, hdfs://, file://"
            ) from None
        try:
            self._write(_TRIED, b"")
            self.remove(_TRIED)
        except Exception as error:
            raise ValueError(f"--results-dir: {url} cannot be written: {_line(error)}") from None
        self._temporary = TemporaryDirectory(prefix="rllib-maobs-", ignore_cleanup_errors=True)
        self.folder = Path(self._temporary.name) / PurePosixPath(self._root).name
        self.folder.mkdir()

    def pull(self, trial: str = "") -> None:
        """Copy what is at the URL into the folder.

        Args:
            trial: Name of one trial, to copy its checkpoints and nothing else; "" for all but checkpoints.
        """
        where = f"{self._root}/{trial}" if trial else self._root
        for info in self._files.get_file_info(fs.FileSelector(where, recursive=True, allow_not_found=True)):
            name = PurePosixPath(info.path).relative_to(self._root)
            if info.type == fs.FileType.File and _in_checkpoint(name) == bool(trial):
                target = self.folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                with self._files.open_input_stream(info.path) as stream:
                    target.write_bytes(stream.read())

    def push(self) -> None:
        """Copy what is in the folder, but for checkpoints, to the URL."""
        for path in sorted(self.folder.rglob("*")):
            name = PurePosixPath(path.relative_to(self.folder).as_posix())
            if path.is_file() and not _in_checkpoint(name) and path.name != LOCK:
                self._write(str(name), path.read_bytes())

    def remove(self, name: str) -> None:
        """Delete a file at the URL."""
        self._files.delete_file(f"{self._root}/{name}")

    def _write(self, name: str, content: bytes) -> None:
        target = PurePosixPath(self._root) / name
        self._files.create_dir(str(target.parent), recursive=True)
        with self._files.open_output_stream(str(target)) as stream:
            stream.write(content)


def shown(args: Namespace) -> str:
    """Return where results go, as it is to be told."""
    return args.storage.url if args.storage else str(args.results_dir)


def _in_checkpoint(name: PurePosixPath) -> bool:
    return any(part.startswith("checkpoint_") for part in name.parts)


def _line(error: Exception) -> str:
    return str(error).partition("\n")[0] or type(error).__name__
