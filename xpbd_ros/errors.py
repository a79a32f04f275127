"""The exception for invalid input, and words of messages."""


class InputError(ValueError):
    """
    Invalid input, described in one line: file, key, value and remedy.

    The command line prints it and exits with 2; the node refuses the request and continues.
    """


LONGEST_LINE = 2000
"""longest error message [characters]"""


def brief(text: str) -> str:
    """Return a text as one line without control characters, shortened to LONGEST_LINE."""
    text = ''.join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    half = LONGEST_LINE // 2
    return text if len(text) <= LONGEST_LINE else f'{text[:half]} … {text[-half:]}'


def plural(noun: str) -> str:
    """Return the plural of a noun."""
    return {'vertex': 'vertices', 'tetrahedron': 'tetrahedra'}.get(noun, f'{noun}s')


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as '1 frame' and '2 frames'."""
    return f'{number} {noun if number == 1 else plural(noun)}'
