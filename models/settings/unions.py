"""Fields that may be one of several kinds of things, and are refused in one sentence."""

from typing import Any

from pydantic import ValidationError, ValidatorFunctionWrapHandler, WrapValidator


def refused_with(expected: str) -> WrapValidator:
    """Return the annotation of a union whose every error is this one.

    Else pydantic gives an error for each member, at a place that has its own name for the member.
    """

    def check(value: Any, validate: ValidatorFunctionWrapHandler) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            raise ValueError(expected) from error

    return WrapValidator(check)
