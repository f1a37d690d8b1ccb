"""The base of all groups of settings. Free of torch: what reads a run must not import it."""

from pydantic import BaseModel, ConfigDict


class Group(BaseModel):
    """A group of settings: unknown keys and infinite numbers are refused; nothing changes afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
