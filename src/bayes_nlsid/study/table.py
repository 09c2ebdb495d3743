"""One table of a study file, read key by key: every key that is never asked for is a mistake of the user's."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, final

from bayes_nlsid.errors import InputError
from bayes_nlsid.study.quantities import quantity

_REQUIRED = object()
FILL_IN = "FILL IN"
"""How an entry begins that a drafted study leaves to the user."""
_KINDS = {"bool": "true or false", "list": "a list", "dict": "a table", "str": "a text", "int": "a whole number", "float": "a number"}


def nearest(word: str, known: Sequence[str]) -> str:
    """A mend that names the nearest known word, or lists what is known."""
    close = difflib.get_close_matches(word.lower(), [k.lower() for k in known], n=1, cutoff=0.6)
    if close:
        return f"did you mean {next(k for k in known if k.lower() == close[0])!r}"
    listed = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
    return f"known are {listed}" if known else "remove it"


def gaps(value: object, place: str = "") -> list[str]:
    """Every entry of a study that is still to be filled in: ``[[recordings.channels]] 2 unit (unit of acc in the file)``."""
    if isinstance(value, dict):
        return [gap for key, inner in value.items() for gap in gaps(inner, f"{place}.{key}" if place else str(key))]
    if isinstance(value, list):
        return [gap for i, inner in enumerate(value) for gap in gaps(inner, f"{place} {i + 1}" if isinstance(inner, dict) else place)]
    if isinstance(value, str) and value.startswith(FILL_IN):
        table, _, key = place.rpartition(".")
        asked = value.removeprefix(FILL_IN).lstrip(": ")
        return [f"[{table}] {key}" + (f" ({asked})" if asked else "")]
    return []


def parse_toml(file: Path, mend: str) -> dict[str, Any]:
    """What a TOML file says; ``mend`` is the advice where there is none.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        return tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(str(file), "there is no such file", mend) from None
    except IsADirectoryError:
        raise InputError(str(file), "is a folder", "give the file inside it, for instance study.toml") from None
    except PermissionError:
        raise InputError(str(file), "cannot be read", "change its permissions") from None
    except UnicodeDecodeError:
        raise InputError(str(file), "is not UTF-8 text", "save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(file), f"is not valid TOML: {error}", "correct that line") from None


@final
class Table:
    """Reader of one TOML table.

    Parameters
    ----------
    file : Path
        The study file; relative paths in it are taken from its folder.
    name : str
        As it stands in the file, e.g. ``"[structure]"``.
    content : dict
        What TOML gave.

    Notes
    -----
    Every method takes ``default``; without one the key is required. `close` must be called last.

    Raises
    ------
    InputError
        By every method, naming file, table and key with the mend: if a key is missing, or its value is of another kind or out of range.
    """

    def __init__(self, file: Path, name: str, content: object) -> None:
        self.file, self.name = file, name
        if not isinstance(content, dict):
            raise InputError(f"{file.name}: {name}", f"is {self._kind(content)}, not a table", f"write it as {name} with keys below it")
        self._content: dict[str, Any] = content
        self._asked: list[str] = []

    def where(self, key: str) -> str:
        """File, table and key, as messages name them."""
        return f"{self.file.name}: {self.name} {key}".replace("  ", " ")

    def wrong(self, key: str, problem: str, mend: str) -> InputError:
        """An error about one key, to be raised by the caller."""
        return InputError(self.where(key), problem, mend)

    def has(self, key: str) -> bool:
        """Whether the key is given; it counts as known from now on."""
        self._asked.append(key)
        return key in self._content

    def raw(self, key: str, default: Any = _REQUIRED) -> Any:
        """The value as TOML gave it."""
        self._asked.append(key)
        if key in self._content:
            return self._content[key]
        if default is _REQUIRED:
            close = difflib.get_close_matches(key, list(self._content), n=1, cutoff=0.75)
            place = f"under {self.name}" if self.name else "at the top"
            mend = f"{close[0]!r} is perhaps meant to be {key!r}" if close else f"add {key} = ... {place}"
            raise self.wrong(key, "is missing", mend)
        return default

    @staticmethod
    def _kind(value: object) -> str:
        return _KINDS.get(type(value).__name__, f"of type {type(value).__name__}")

    def text(self, key: str, default: Any = _REQUIRED, choices: Sequence[str] = ()) -> Any:
        """A text, one of ``choices`` if given."""
        value = self.raw(key, default)
        if value is default:
            return default
        if not isinstance(value, str):
            raise self.wrong(key, f"is {self._kind(value)}, not a text", f'write {key} = "..."')
        if choices and value not in choices:
            raise self.wrong(key, f"{value!r} is not possible", nearest(value, choices))
        return value

    def flag(self, key: str, default: Any = _REQUIRED) -> Any:
        """True or false."""
        value = self.raw(key, default)
        if value is not default and not isinstance(value, bool):
            raise self.wrong(key, f"is {self._kind(value)}, not true or false", f"write {key} = true or {key} = false")
        return value

    def integer(self, key: str, default: Any = _REQUIRED, low: int = 0, high: int | None = None) -> Any:
        """A whole number within limits."""
        value = self.raw(key, default)
        if value is default:
            return default
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(key, f"is {self._kind(value)}, not a whole number", f"write {key} = {low} or more")
        if value < low or (high is not None and value > high):
            limit = f"to {high}" if high is not None else "up"
            raise self.wrong(key, f"{value} is out of range", f"write a whole number from {low} {limit}")
        return value

    def number(self, key: str, dimension: str = "number", default: Any = _REQUIRED, *, positive: bool = False) -> Any:
        """A number in SI, or a text with its unit; optionally positive."""
        value = self.raw(key, default)
        if value is default:
            return default
        number = quantity(value, dimension, self.where(key))
        if positive and not number > 0:
            raise self.wrong(key, f"{value} is not positive", "write a number above zero")
        return number

    def items(self, key: str, default: Any = _REQUIRED) -> Any:
        """A list; a single value counts as a list of one."""
        value = self.raw(key, default)
        if value is default:
            return default
        return value if isinstance(value, list) else [value]

    def texts(self, key: str, default: Any = _REQUIRED) -> Any:
        """A tuple of texts."""
        values = self.items(key, default)
        if values is default:
            return default
        wrong = [v for v in values if not isinstance(v, str)]
        if wrong:
            raise self.wrong(key, f"holds {self._kind(wrong[0])} where a text belongs", f'write {key} = ["...", "..."]')
        return tuple(values)

    def integers(self, key: str, default: Any = _REQUIRED, low: int = 1) -> Any:
        """A tuple of distinct whole numbers."""
        values = self.items(key, default)
        if values is default:
            return default
        if any(isinstance(v, bool) or not isinstance(v, int) or v < low for v in values) or len(set(values)) != len(values) or not values:
            raise self.wrong(key, f"{values} is not a list of different whole numbers from {low} up", f"write {key} = [{low}, {low + 1}]")
        return tuple(values)

    def numbers(self, key: str, dimension: str = "number", default: Any = _REQUIRED) -> Any:
        """A tuple of numbers in SI."""
        values = self.items(key, default)
        if values is default:
            return default
        return tuple(quantity(v, dimension, self.where(key)) for v in values)

    def span(self, key: str, dimension: str, default: Any = _REQUIRED) -> Any:
        """Two numbers, the first below the second and not negative."""
        value = self.raw(key, default)
        if value is default:
            return default
        if not isinstance(value, list) or len(value) != 2:
            raise self.wrong(key, f"{value!r} is not a pair", f"write {key} = [from, to]")
        low, high = (quantity(v, dimension, self.where(key)) for v in value)
        if not 0 <= low < high:
            raise self.wrong(key, f"{value} does not run from a lower to a higher value", f"write {key} = [from, to] with 0 <= from < to")
        return low, high

    def path(self, key: str, default: Any = _REQUIRED) -> Any:
        """An existing file, relative to the study file."""
        value = self.text(key, default)
        if value is default:
            return default
        if "\0" in value:
            raise self.wrong(key, "holds a null character", "write the name of a file")
        path = (self.file.parent / value).resolve()
        if not path.is_file():
            raise self.wrong(key, f"there is no file {path}", "correct the name; paths are taken from the folder of the study file")
        return path

    def table(self, key: str) -> Table | None:
        """A table inside this one, or None."""
        value = self.raw(key, None)
        return None if value is None else Table(self.file, f"[{self._inner(key)}]", value)

    def tables(self, key: str) -> Iterator[Table]:
        """The tables of an array of tables, numbered from 1 in messages."""
        value = self.raw(key, [])
        if not isinstance(value, list) or any(not isinstance(v, dict) for v in value):
            raise self.wrong(key, f"is {self._kind(value)}, not a list of tables", f"head each entry with [[{self._inner(key)}]]")
        for i, content in enumerate(value):
            yield Table(self.file, f"[[{self._inner(key)}]] {i + 1}", content)

    def _inner(self, key: str) -> str:
        outer = self.name.replace("[", "").replace("]", "").split(" ")[0]
        return f"{outer}.{key}" if outer else key

    def keys(self) -> tuple[str, ...]:
        """Every key the user wrote; all of them count as known (for tables whose keys are names)."""
        self._asked += list(self._content)
        return tuple(self._content)

    def close(self) -> None:
        """Refuse keys that nothing asked for.

        Raises
        ------
        InputError
            Naming the first unknown key and the nearest known one.
        """
        known = list(dict.fromkeys(self._asked))
        for key in self._content:
            if key not in known:
                raise self.wrong(key, "is not a key that is known here", nearest(key, known))
