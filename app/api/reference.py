"""`/v1/skeletons`, `/v1/limits`, `/v1/quality`: what a client has to know beforehand."""

from dataclasses import asdict

from fastapi import APIRouter

from app.api.dependencies import SettingsNeeded
from app.api.openapi import needs, problems
from app.api.schemas import (
    FlagOut,
    LimitsOut,
    QualityOut,
    SkeletonJoint,
    SkeletonOut,
    SkeletonsOut,
)
from app.domain.limits import FEATURES, read_limits
from app.domain.motion import FLAGS
from models.skeleton import SKELETONS, Skeleton

router = APIRouter(tags=["reference"])
OPEN = needs(None)


@router.get(
    "/v1/skeletons", summary="List skeleton formats", openapi_extra=OPEN, responses=problems()
)
async def list_skeletons() -> SkeletonsOut:
    """List the formats in which poses may come, with the order of their joints."""
    return SkeletonsOut(items=[_show(skeleton) for skeleton in SKELETONS.values()])


@router.get("/v1/limits", summary="Get the limits", openapi_extra=OPEN, responses=problems())
async def get_limits(settings: SettingsNeeded) -> LimitsOut:
    """Give what a client may send at most, and what this server can do."""
    return LimitsOut(**asdict(read_limits(settings)), features=list(FEATURES))


@router.get("/v1/quality", summary="List quality flags", openapi_extra=OPEN, responses=problems())
async def list_quality() -> QualityOut:
    """List every flag that a forecast may carry, and how bad each is."""
    return QualityOut(items=[FlagOut.model_validate(flag) for flag in FLAGS])


def _show(skeleton: Skeleton) -> SkeletonOut:
    parents = skeleton.parents or (-1,) * len(skeleton.joints)
    joints = zip(skeleton.joints, parents, skeleton.forecast, strict=True)
    return SkeletonOut(
        name=skeleton.name,
        root_relative=skeleton.root_relative,
        layout_sha256=skeleton.layout_sha256,
        joints=[
            SkeletonJoint(name=name, parent=None if parent < 0 else parent, forecast=forecast)
            for name, parent, forecast in joints
        ],
        bones=list(skeleton.bones),
    )
