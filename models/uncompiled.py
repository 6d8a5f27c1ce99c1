"""Why a model cannot become C."""


class UncompiledError(RuntimeError):
    """No compiler, one that fails, or no place for what it makes. It says what to do."""
