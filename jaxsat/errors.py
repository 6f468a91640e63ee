"""The one exception that is written for people."""


class InputError(ValueError):
    """Bad input: one sentence that says what is wrong, where, and what to do.

    Raised only where data, configuration or arguments enter (readers, configuration, command line
    and the checks of `estimate`). The command line prints it on one line and exits with code 2.
    """
