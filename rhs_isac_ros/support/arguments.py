"""Command lines: a parser with one-line errors, and types of arguments."""

import argparse
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import Field
from rhs_isac_ros.support.files import check_writable, parse_yaml
from rhs_isac_ros.support.pictures import picture_format

_Parsed = TypeVar('_Parsed')


class _Formatter(argparse.ArgumentDefaultsHelpFormatter):
    """A formatter that shows defaults which the help of an option does not state."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        is_stated = 'default' in (action.help or '') or any(
            action.default is one for one in (None, False, ''))
        return action.help if is_stated else super()._get_help_string(action)


class HelpFormatter(_Formatter, argparse.RawDescriptionHelpFormatter):
    """A formatter that also keeps line breaks of the description and epilog."""


class ArgumentParser(argparse.ArgumentParser):
    """A parser whose usage errors are one line with a hint; options cannot be abbreviated.

    The help shows the default of each option once.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **{
            'allow_abbrev': False, 'formatter_class': _Formatter, **options})

    def parse_known_args(  # type: ignore[override]
            self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments, which must be UTF-8: they are printed, and passed to libraries."""
        words = sys.argv[1:] if args is None else list(args)
        for word in words:
            try:
                word.encode()
            except UnicodeEncodeError:
                self.error(f'argument {word!a}: expected UTF-8')
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        """Print an error as one line, and exit with code 2."""
        # An argument may contain line breaks.
        text = ' '.join(message.split())
        self.exit(2, f'{self.prog}: error: {text}; see {self.prog} --help\n')


def typed(parse: Callable[[str], _Parsed]) -> Callable[[str], _Parsed]:
    """Return a type for argparse whose errors are the ValueErrors of a function of the text."""
    def parse_argument(text: str) -> _Parsed:
        with translated(ValueError, argparse.ArgumentTypeError):
            return parse(text)
    return parse_argument


def _number(declared: Field) -> Callable[[str], Any]:
    """Return a type for argparse that parses and checks a declared number."""
    def parse(text: str) -> Any:
        try:
            number = declared.kind(text)
        except ValueError:
            number = text
        if problem := declared.problem(number):
            raise argparse.ArgumentTypeError(problem)
        return number
    return parse


def integer(low: int, high: int = 10**9) -> Callable[[str], int]:
    """Return a type for argparse: integers from `low` to `high`."""
    return _number(Field(int, low=low, high=high))


# Further types for argparse.
positive_int = integer(1)
# Every such seed is also valid as a ROS parameter.
seed = integer(0, 2**31 - 1)
positive_float = _number(Field(float, low=0, is_open=True))
nonnegative_float = _number(Field(float, low=0))
share = _number(Field(float, low=0, high=1))


def interval(text: str) -> tuple[float, float]:
    """Parse LOW:HIGH, positive numbers with LOW <= HIGH, or raise ArgumentTypeError."""
    low, colon, high = text.partition(':')
    try:
        numbers = positive_float(low), positive_float(high)
    except argparse.ArgumentTypeError:
        numbers = math.inf, 0.0
    if not colon or numbers[0] > numbers[1]:
        raise argparse.ArgumentTypeError(f'{text!r}, expected LOW:HIGH with 0 < LOW <= HIGH')
    return numbers


def input_file(text: str) -> Path:
    """Parse the path of a file that can be read, or raise argparse.ArgumentTypeError."""
    path = input_path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f'{text}: a directory, expected a file')
    return path


def input_path(text: str) -> Path:
    """Parse the path of a file or folder that can be read; raise as `input_file`."""
    path = Path(text)
    # The file is not opened, because the content of a pipe can be read only once.
    if not text or not os.path.exists(path):
        raise argparse.ArgumentTypeError(f'{text!r}, expected an existing file')
    if not os.access(path, os.R_OK):
        raise argparse.ArgumentTypeError(f'{text}: expected a file that can be read')
    return path


def output_file(text: str) -> Path:
    """Parse the path of a file that can be written, or raise argparse.ArgumentTypeError."""
    try:
        if not text:
            raise OSError("'', expected a file")
        check_writable(Path(text))
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(
            f'{error.filename}: {error.strerror}'
            if isinstance(error, OSError) and error.strerror else str(error)) from None
    return Path(text)


def picture_file(text: str) -> Path:
    """Parse the path of a picture that can be written, or raise argparse.ArgumentTypeError."""
    with translated(ValueError, argparse.ArgumentTypeError):
        picture_format(text)
    return output_file(text)


def output_folder(text: str) -> Path:
    """Parse the path of a folder that can be written or created, or raise ArgumentTypeError."""
    path = Path(text)
    # Find the folder or its nearest ancestor that exists; the root always does.
    try:
        found = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
        if not text or not found.is_dir():
            raise OSError
        check_writable(found / 'file')
    except (OSError, ValueError):
        raise argparse.ArgumentTypeError(
            f'{text!r}, expected a folder that is writable or can be created'
        ) from None
    return path


def parse_options(text: str) -> dict[str, Any]:
    """Parse options such as ``port=/dev/ttyUSB0 read_back=false``; the values are those of YAML.

    Quotes enclose a value with spaces. Raises ValueError if the text has another form.
    """
    options: dict[str, Any] = {}
    for word in shlex.split(text):
        name, equals, value = word.partition('=')
        if not (name.isidentifier() and equals) or name in options:
            raise ValueError(f'{word!r}, expected NAME=VALUE, each name once')
        options[name] = parse_yaml(value)
    return options


def check_distinct(
        parser: argparse.ArgumentParser, options: argparse.Namespace, unused: str = '') -> None:
    """Exit with a usage error if an output file is also an input or another output.

    `unused` names an option that has no effect, so that its default need not be distinct.
    """
    outputs, names = (output_file, picture_file), dict[Path, str]()
    # Inputs come first.
    for action in sorted(parser._actions, key=lambda action: action.type in outputs):
        path, name = getattr(options, action.dest, None), (*action.option_strings, action.dest)[0]
        if isinstance(path, Path) and action.dest != unused:
            other = names.setdefault(path.resolve(), name)
            if other != name and action.type in outputs:
                parser.error(f'argument {name}: {path}, expected a file other than {other}')


def check_effect(parser: argparse.ArgumentParser, options: argparse.Namespace,
                 names: Iterable[str], has_effect: object, expected: str) -> None:
    """Exit with a usage error if options are given that have no effect beside the others."""
    for name in names:
        if not has_effect and str(getattr(options, name)) != str(parser.get_default(name)):
            parser.error(f'argument --{name.replace("_", "-")}: no effect, expected {expected}')
