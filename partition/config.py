"""The two numbers of G²PS that a user may change; the block grid is the third and lives in `cells.Grid`."""

from pydantic import BaseModel, ConfigDict, Field


class PartitionConfig(BaseModel):
    """How G²PS bounds the scene and hands cameras to blocks."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    rho_tri: float = Field(
        default=5.0,
        ge=0.0,
        description="Triangulation range factor: the AABB reaches this many median camera distances past the "
        "trajectory (eq. 7; the paper's value for all scenes).",
    )
    tau_grad: float = Field(
        default=0.8,
        ge=0.0,
        le=1.0,
        description="A camera also trains every block whose gradient score is more than this share of its "
        "best block's (eq. 11; the paper's value). 1 assigns by position only.",
    )
