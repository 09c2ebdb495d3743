"""The one exception for bad input: file, field, and how to mend it, in one sentence."""

from __future__ import annotations

from typing import final


@final
class InputError(ValueError):
    """Something the user gave cannot be used.

    Parameters
    ----------
    where : str
        File and field, e.g. ``"study.toml: [structure] kind"``.
    problem : str
        What is wrong, in words.
    mend : str
        What to do about it.
    """

    def __init__(self, where: str, problem: str, mend: str) -> None:
        self.where, self.problem, self.mend = where, problem, mend
        super().__init__(f"{where}: {problem}; {mend}.")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Keep the three parts when the error crosses a process boundary."""
        return InputError, (self.where, self.problem, self.mend)
