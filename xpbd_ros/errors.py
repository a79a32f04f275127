"""The one error that a user's mistake raises."""


class InputError(ValueError):
    """
    Bad input, said in one line: where, what, the value, and the way out.

    The command line prints it and exits with 2; the node refuses what was asked and goes on.
    """
