"""Which answer of a fit this is."""

from typing import Literal

from typing_extensions import TypeAliasType

AnswerStage = TypeAliasType("AnswerStage", Literal["geometry", "network"])

STAGES = (
    "`geometry`: the first answer, of static cameras alone, which is there while the network is "
    "still taught; another takes its place. `network`: the fit's own, which stays."
)
