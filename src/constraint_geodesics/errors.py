"""What a user can do wrong before anything heavy is loaded."""


class WrongUsageError(ValueError):
    """Something was named that is not there, or cannot be meant."""


class ParamsError(WrongUsageError):
    """params.yaml can't be used; the message is one line with the entry, its value and what is
    allowed.
    """
