"""The one error that a user's mistake raises."""


class InputError(ValueError):
    """
    Bad input, said in one line: where, what, the value, and the way out.

    The command line prints it and exits with 2; the node refuses what was asked and goes on.
    """


LONGEST_LINE = 2000
"""of what is said about a mistake, in characters"""


def brief(text: str) -> str:
    """Return a text that may quote anything as one line: no control characters, not too long."""
    text = ''.join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    half = LONGEST_LINE // 2
    return text if len(text) <= LONGEST_LINE else f'{text[:half]} … {text[-half:]}'
