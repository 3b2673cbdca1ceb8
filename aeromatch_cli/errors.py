"""The errors that a user can cause. The library raises them; the command line turns them into exit codes."""


class AeromatchError(Exception):
    """Root of every error raised on purpose. The message says what is wrong, where, and what to do.

    `exit_code` is what a shell sees: 2 for bad arguments or configuration, 3 when nothing usable is left.
    """

    exit_code = 3


class ConfigError(AeromatchError):
    """A setting, an argument or an input list is wrong: nothing was started."""

    exit_code = 2


class InputError(AeromatchError):
    """The input was read, and nothing in it can be used (no image, no pair, no match)."""


class ItemError(AeromatchError):
    """One image or one pair cannot be processed. Stages record it in failures.csv and go on with the rest."""


class WorkspaceError(AeromatchError):
    """The workspace cannot be read or written (permissions, full disk, written by another version)."""


class BrokenFileError(WorkspaceError):
    """A file of the workspace is missing or damaged, and can be made again once it is deleted."""

    def __init__(self, path: str, reason: str) -> None:
        super().__init__(path, reason)  # the arguments travel back from worker processes
        self.path, self.reason = path, reason

    def __str__(self) -> str:
        return f"cannot read {self.path}: {self.reason}; delete it to have it made again"


# What Python and native libraries say that get no memory.
_NO_MEMORY = (
    "MemoryError", "bad_alloc", "Cannot allocate memory", "can't allocate memory", "can't start new thread",
    "failed to map segment", "Insufficient memory", "Memory allocation still failed",
)  # fmt: skip


def tells_of_memory(text: str) -> bool:
    """Whether the text of an error, or what a process said at its end, tells of a lack of memory."""
    return any(words in text for words in _NO_MEMORY)


def lacks_memory(error: BaseException) -> bool:
    """Whether an error comes from a lack of memory, whatever class a library gives it."""
    return isinstance(error, MemoryError) or tells_of_memory(str(error))
