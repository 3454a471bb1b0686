"""An SSP unpacked: the system descriptions at its top, and the files that its documents name by URI."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote, urlsplit

from fmus.archive import unpack
from fmus.component import ConfigurationError
from fmus.model import unknown

DEFAULT = "SystemStructure.ssd"


@dataclass(frozen=True)
class Package:
    """The folder of an unpacked SSP, the hash of the archive, and what messages call it."""

    folder: Path
    sha256: str
    shown: str

    @property
    def descriptions(self) -> list[str]:
        """The files of the system descriptions, the default first."""
        names = sorted(file.name for file in self.folder.glob("*.ssd") if file.is_file())
        return sorted(names, key=lambda name: name != DEFAULT)

    def description(self, name: str) -> Path:
        """The file of the system description of this name, with or without `.ssd`; the default for no name.

        Raises ConfigurationError: there is none.
        """
        known = self.descriptions
        wanted = name if name.endswith(".ssd") else f"{name}.ssd"
        if not name and DEFAULT not in known:
            raise ConfigurationError(f"{self.shown}: wants a {DEFAULT} at its top, found {', '.join(known) or 'none'}")
        if name and wanted not in known:
            raise ConfigurationError(f"{self.shown}: {unknown(wanted, known, 'system description')}")
        return self.folder / (wanted if name else DEFAULT)

    def inside(self, file: Path) -> str:
        """A file of the package as messages call it."""
        return f"{self.shown}/{file.relative_to(self.folder).as_posix()}"


def open_package(path: Path, shown: str) -> Package:
    """The SSP at `path`, unpacked once, within limits. Raises ConfigurationError: as fmus.archive.unpack does."""
    if not path.is_file():
        raise ConfigurationError(f"{path}: wants an SSP file, found {'a folder' if path.is_dir() else 'nothing'} there")
    found = unpack(path)
    return Package(found.folder.resolve(), found.sha256, shown)


def resource(uri: str, base: Path, within: Path) -> Path:
    """The file that a relative URI names, seen from the folder `base`, which must lie `within` a folder.

    Raises ConfigurationError: it is no relative path, leads outside, or no such file is there.
    """
    parts = urlsplit(uri)
    name = unquote(parts.path).replace("\\", "/")
    if parts.scheme or parts.netloc or name.startswith("/") or not name:
        raise ConfigurationError(f"wants the relative path of a file in the package, got '{uri}'")
    path = (base / name).resolve()
    if not path.is_relative_to(within.resolve()):
        raise ConfigurationError(f"leads outside of the package: '{uri}'")
    if not path.is_file():
        near = [file.relative_to(base).as_posix() for file in sorted(base.rglob("*")) if file.is_file()]
        raise ConfigurationError(unknown(name, near, "file in the package"))
    return path
