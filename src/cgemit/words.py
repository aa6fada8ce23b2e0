"""Words of messages."""

import difflib
from collections.abc import Iterable


def did_you_mean(word: object, known: Iterable[object], before: str = "") -> str:
    """Return ``did you mean "pitch_x"?`` for the nearest known word, after `before`; an empty text if none is near.

    Case counts first (GeV is not Gev), but a word in the wrong case is recognised, too. What is no text is near none.
    """
    if not isinstance(word, str):
        return ""
    names = [name for name in known if isinstance(name, str)]
    by_lower = {name.lower(): name for name in names}
    close = difflib.get_close_matches(word, names, n=1)
    close = close or [by_lower[name] for name in difflib.get_close_matches(word.lower(), by_lower, n=1)]
    return f'{before}did you mean "{close[0]}"?' if close else ""
