"""Atomic writing of files, reading of YAML, and files of arrays with a description."""

import contextlib
import functools
import io
import json
import math
import os
import re
import secrets
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Hashable, Iterator, Mapping, Set
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import yaml

from rhs_isac_ros.support.fields import DECIMAL
from rhs_isac_ros.support.optional import MissingLibraryError, optional_import

_T = TypeVar('_T')
# Methods by which NumPy stores arrays. Others have errors whose types some Pythons lack.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Maximum sizes [bytes] of the arrays of an archive, and of a YAML file. The memory needed to read
# a YAML file is up to 240 times its size.
_MAX_BYTES, _MAX_YAML_BYTES = 2**28, 2**24
# Maximum depth of the lists and mappings of a YAML file.
_MAX_YAML_DEPTH = 16
_INT, _FLOAT = 'tag:yaml.org,2002:int', 'tag:yaml.org,2002:float'


# The loader in C reads a codebook ten times as fast; some builds of PyYAML lack it.
class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """A loader that refuses repeated keys, and reads numbers only in decimal notation.

    A number such as ``010``, ``0x1F``, ``1_000`` or ``-1:30`` is read as text.
    """

    # YAML 1.1 reads `010` as 8, and `-1:30` as -90.
    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_INT, _FLOAT)]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Convert a mapping; raise ValueError if it contains a key twice."""
        known = set()
        for one, _ in node.value:
            key = self.construct_object(one, deep=True)
            if not isinstance(key, Hashable):
                continue  # An error of the base class.
            if key in known:
                raise ValueError(
                    f'{key}: repeated in line {one.start_mark.line + 1}, expected one value')
            known.add(key)
        return super().construct_mapping(node, deep)


for _tag, _pattern, _first in (
        (_INT, re.compile(r'(?:[-+]?(?:0|[1-9][0-9]*))$'), '-+0123456789'),
        (_FLOAT, re.compile(
            # As in YAML 1.1, a float contains a point.
            rf'(?:(?=[^.]*\.)(?:{DECIMAL.pattern})|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$'),
         '-+.0123456789')):
    _Loader.add_implicit_resolver(_tag, _pattern, list(_first))


class ArchiveError(ValueError):
    """A file cannot be read, or is not an archive of the expected kind."""


def read_once(load: Callable[[Any, str | Path], _T]) -> Callable[[Any, str | Path], _T]:
    """Decorate a class method that reads a file: until the file changes, it is read only once."""
    @functools.lru_cache(maxsize=8)
    def read(kind: Any, path: str, _: tuple[int, ...]) -> _T:
        return load(kind, path)

    @functools.wraps(load)
    def read_unless_known(kind: Any, path: str | Path) -> _T:
        # The content of a pipe can be read only once. `load` describes other errors.
        if not os.path.isfile(path):
            return load(kind, path)
        status = os.stat(path)
        return read(kind, str(path), (
            status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size))
    return read_unless_known


def write_whole(path: str | Path, content: str | bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file atomically: write a temporary file, then rename it to `path`.

    The content may be a callable that writes it to a binary stream. Raises OSError if the file
    cannot be written; an existing file is then left unchanged.
    """
    path = Path(path)
    # Files of `tempfile` would have narrower permissions than other new files.
    temporary = path.with_name(f'.{path.name}.{secrets.token_hex(4)}')
    with writing(path):
        stream = open(temporary, 'xb')
        try:
            with stream:
                if callable(content):
                    content(stream)
                else:
                    stream.write(content.encode() if isinstance(content, str) else content)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise


def save_or_rescue(save: Callable[[Path], None], path: Path) -> None:
    """Save the result of long work; if that fails, save it in a temporary directory, too.

    Raises OSError, which names the copy, if `path` cannot be written.
    """
    try:
        save(path)
    except OSError as error:
        rescue = Path(tempfile.mkdtemp(prefix='rhs_isac_ros.')) / path.name
        try:
            save(rescue)
        except OSError:
            rescue.parent.rmdir()
            raise error from None
        raise OSError(f'{error}; the result is in {rescue}') from None


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Let an error of the system in a block that writes a file, such as a full disk, name it."""
    try:
        yield
    except OSError as error:
        if error.errno:
            # Not the name of a temporary file.
            error.filename = str(path)
            del error.filename2
        raise


def check_writable(path: Path) -> None:
    """Raise OSError if `write_whole` cannot write a file, or would replace a special file."""
    if path.is_dir():
        raise IsADirectoryError(f'{path}: a directory, expected a file')
    if path.exists() and not path.is_file():
        raise OSError(f'{path}: expected a regular file')
    try:
        # Permissions do not show whether the file system is read-only.
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError:
        raise OSError(f'{path}: expected a file in a directory that exists and can be '
                      'written') from None
    # The name of the temporary file is longer and may exceed the limit of the file system.
    with contextlib.suppress(FileNotFoundError):
        os.lstat(path.parent / f'.{path.name}.{"x" * 8}')


def mapping_of(content: Any, required: Set[str], optional: Set[str] = frozenset()
               ) -> dict[str, Any]:
    """Return a mapping with the required keys and none beyond the optional ones.

    Raises ValueError for any other content.
    """
    if not isinstance(content, dict) or not required <= content.keys() <= required | optional:
        keys = sorted(map(str, content)) if isinstance(content, dict) else content
        raise ValueError(f'{keys}, expected the keys {sorted(required)}'
                         + (f' and, if needed, {sorted(optional)}' if optional else ''))
    return content


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file; raise ValueError if it cannot be read or `parse_yaml` fails."""
    try:
        with open(path, 'rb') as stream:
            return parse_yaml(stream.read(_MAX_YAML_BYTES + 1).decode())
    except (OSError, ValueError) as error:
        raise ValueError(f'{path}: cannot be read: {_reason(error)}') from error


def write_yaml(path: str | Path, content: Mapping[str, Any], about: str = '') -> None:
    """Write plain values as YAML behind a comment, if any; raise OSError if this fails."""
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    write_whole(path, f'# {about}\n{text}' if about else text)


def _reason(error: Exception) -> str:
    """Return the text of an error in one line, without the name of a file."""
    return ' '.join(str(getattr(error, 'strerror', None) or error).split())


def parse_yaml(text: str) -> Any:
    """Parse a text in YAML, with numbers in decimal notation.

    Raises ValueError if the text is invalid, too long or nested too deeply, repeats a key, or
    contains references, with which a short text can describe an enormous value.
    """
    if len(text.encode()) > _MAX_YAML_BYTES:
        raise ValueError(f'more than {_MAX_YAML_BYTES} bytes')
    depth = 0
    try:
        # In the C loader, deep nesting would crash the process.
        for event in yaml.parse(text, _Loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_YAML_DEPTH:
                raise ValueError(f'nested more than {_MAX_YAML_DEPTH} times')
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f'reference *{event.anchor}, expected none')
        return yaml.load(text, _Loader)
    # PyYAML also raises ValueError, for impossible dates.
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(_reason(error)) from error


def write_archive(path: str | Path, arrays: Mapping[str, np.ndarray | float],
                  about: Mapping[str, Any]) -> None:
    """Write arrays and a JSON-compatible description to a file of NumPy's format ``.npz``."""
    write_arrays(path, {**arrays, 'about': json.dumps(about)})


def write_arrays(path: str | Path, arrays: Mapping[str, Any],
                 save: Callable[..., None] = np.savez) -> None:
    """Write arrays to a file of NumPy's format ``.npz``; `save` may also compress them."""
    # If the disk is full, NumPy before 2 leaves an archive open, which later reports a second
    # error. In memory, there is always space.
    archive = io.BytesIO()
    save(archive, **arrays)
    write_whole(path, archive.getvalue())


def read_arrays(path: str | Path, names: set[str] | None = None) -> dict[str, np.ndarray]:
    """Read the arrays of a file of NumPy's format ``.npz``; a ``.npy`` file yields none.

    With `names`, the result is empty unless the file has exactly these arrays, apart from
    ``about``, and stores them uncompressed; compressed arrays may be far larger than the file.
    Raises ArchiveError if the file cannot be read, is damaged, or contains more than 256 MiB.
    """
    try:
        with open(path, 'rb') as stream:
            if not stream.read(6).startswith((b'PK', b'\x93NUMPY')):
                raise ValueError('no arrays, expected a file of the format .npz')
            stream.seek(0)
            file = np.load(stream, allow_pickle=False)
            found = getattr(file, 'files', ())
            members = file.zip.infolist() if found else []
            if names is not None and (set(found) - {'about'} != names or any(
                    member.compress_type for member in members)):
                return {}
            if any(member.compress_type not in _METHODS for member in members):
                raise ValueError('compressed by another method than NumPy uses')
            if sum(member.file_size for member in members) > _MAX_BYTES:
                raise ValueError('more than 256 MiB of arrays')
            return {key: file[key] for key in found}
    # Reading verifies the checksum of every array. A header may declare any shape.
    # `zipfile` raises RuntimeError for an entry that is marked as encrypted.
    except (OSError, ValueError, EOFError, RuntimeError, SyntaxError, KeyError, MemoryError,
            OverflowError, zipfile.BadZipFile, zlib.error) as error:
        raise ArchiveError(f'{path}: cannot be read: {_reason(error)}') from error


def read_matlab(path: str | Path, names: set[str]) -> dict[str, np.ndarray]:
    """Read the arrays of these names in a file of MATLAB, of version 5 or 7.3.

    Version 7.3 needs h5py. Raises ArchiveError if the file cannot be read, contains more than 256
    MiB of these arrays, or one of them has no numbers.
    """
    try:
        with open(path, 'rb') as stream:
            reader = _read_hdf5 if b'MATLAB 7.3' in stream.read(128) else _read_matlab5
        found = reader(path, names)
        for name, array in found.items():
            if array.dtype.kind not in 'biufc':
                raise ArchiveError(f'{name}: {array.dtype}, expected numbers')
    except MissingLibraryError:
        raise
    except ArchiveError as error:
        raise ArchiveError(f'{path}: cannot be read: {error}') from error
    # The readers raise many kinds of errors for damaged files, and for other formats of Octave.
    except Exception as error:
        raise ArchiveError(f'{path}: cannot be read: {_reason(error)}; expected arrays that '
                           'MATLAB, or Octave with save -v7, has written') from error
    return found


def _read_matlab5(path: str | Path, names: set[str]) -> dict[str, np.ndarray]:
    from scipy.io import loadmat, whosmat

    shapes = [shape for name, shape, _ in whosmat(path) if name in names]
    if sum(16 * math.prod(shape) for shape in shapes) > _MAX_BYTES:
        raise ArchiveError('more than 256 MiB of arrays')
    found = loadmat(path, variable_names=names)
    return {name: found[name] for name in names & {*found}}


def _read_hdf5(path: str | Path, names: set[str]) -> dict[str, np.ndarray]:
    with optional_import('reading files of MATLAB 7.3', extra='matlab'):
        import h5py

    with h5py.File(path) as file:
        sets = {name: file[name] for name in names & {*file}}
        for name, one in sets.items():
            if not isinstance(one, h5py.Dataset):
                raise ArchiveError(f'{name}: a structure or a sparse matrix, expected numbers')
        if sum(16 * one.size for one in sets.values()) > _MAX_BYTES:
            raise ArchiveError('more than 256 MiB of arrays')
        # The axes are reversed. An empty array is stored as its shape.
        return {name: np.empty(one[()].astype(int)) if one.attrs.get('MATLAB_empty')
                else _complex(one[()]).T for name, one in sets.items()}


def _complex(array: np.ndarray) -> np.ndarray:
    """Return pairs of real and imaginary parts as complex numbers, and other arrays unchanged."""
    if array.dtype.names != ('real', 'imag'):
        return array
    return array['real'] + 1j * array['imag']


def read_archive(path: str | Path, kind: str, version: int, names: set[str]
                 ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays and their description, from which the key ``format`` is removed.

    Raises ArchiveError if the file cannot be read, is damaged or compressed, has a format other
    than `version`, or arrays other than `names`. `kind` describes the content in errors.
    """
    arrays = read_arrays(path, names)
    try:
        about = json.loads(str(arrays.pop('about', '{}')))
    except (ValueError, RecursionError) as error:
        raise ArchiveError(f'{path}: cannot be read: {error}') from error
    if not isinstance(about, dict) or about.pop('format', 0) != version or set(arrays) != names:
        raise ArchiveError(
            f'{path}: not a {kind}, expected a {kind} file of format {version}')
    return arrays, about
