"""What a user can do wrong before anything heavy is loaded."""


class ParamsError(ValueError):
    """params.yaml can't be used; the message is one line with the entry, its value and what is
    allowed.
    """
