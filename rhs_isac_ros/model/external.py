"""Scenario values that come from elsewhere: arrays read from a file, or objects of plug-ins."""

import abc
import functools
import hashlib
import re
from typing import Any, ClassVar

import numpy as np

from rhs_isac_ros.support import plugins


class External(abc.ABC):
    """A scenario value from a file or plug-in; two of a class are equal if their digests are."""

    origin: str  #: Path of the file, or name of the plug-in; empty for other values.
    # For error messages: the kind of value, and the values that a scenario accepts.
    WORDS: ClassVar[tuple[str, str]]

    @classmethod
    @abc.abstractmethod
    def load(cls, origin: Any) -> 'External':
        """Load the value from its origin; raise ValueError if there is no valid value."""

    @classmethod
    def named(cls, text: str) -> 'External':
        """Load a value by its origin, which may be followed by ``@`` and the expected digest.

        A value without an origin is one of this process, or of the process that runs the job.
        Raises ValueError if there is no valid value or the digest differs.
        """
        if isinstance(held := plugins.GIVEN.get(('', text), plugins.HELD.get(text)), cls):
            return held
        origin, expected = re.fullmatch(  # type: ignore[union-attr]
            r'(.*?)(?:@([0-9a-f]{16}))?', text, re.DOTALL).groups()
        if not origin:
            raise ValueError(f'{text!r}: {cls.WORDS[0]} without an origin, expected '
                             f'{cls.WORDS[1]}')
        value = cls.load(origin)
        if expected and value.digest != expected:
            raise ValueError(f'{origin}: digest {value.digest}, expected {expected}: the content '
                             'has changed')
        return value

    @functools.cached_property
    def digest(self) -> str:
        """16 hexadecimal digits that identify the content in all processes."""
        raise NotImplementedError

    def held(self) -> 'External':
        """Return the value, which `named` finds by its text while it is in use."""
        if not self.origin:
            plugins.HELD[str(self)] = self
        return self

    def __str__(self) -> str:
        """Return the origin and the digest in the form that `named` reads."""
        return f'{self.origin}@{self.digest}'

    def __repr__(self) -> str:
        """Return a description that is the same in all processes."""
        return f'{type(self).__name__}({self.digest!r})'

    def __eq__(self, other: object) -> bool:
        """Return whether the contents are the same."""
        return isinstance(other, type(self)) and self.digest == other.digest

    def __hash__(self) -> int:
        """Return a hash of the content."""
        return hash(self.digest)


class ArrayFile(External):
    """A value that consists of arrays in a file."""

    WORDS = 'arrays', 'the path of a file, or null'

    @abc.abstractmethod
    def content(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that the digest covers."""

    @abc.abstractmethod
    def misfit(self, scenario: Any) -> str:
        """Return the reason why the arrays do not fit a scenario, or '' if they fit."""

    @functools.cached_property
    def digest(self) -> str:
        """16 hexadecimal digits that identify the content."""
        digest = hashlib.sha256()
        for array in self.content():
            little = np.ascontiguousarray(array, array.dtype.newbyteorder('<'))
            digest.update(f'{array.dtype.kind}{array.shape}'.encode())
            digest.update(little.tobytes())
        return digest.hexdigest()[:16]
