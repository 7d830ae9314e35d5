"""A stage's checks as Dagster's: their specs, and the verdicts of one scene."""

import math
from collections.abc import Iterable, Iterator
from typing import Any

import dagster as dg

# Not exported by Dagster, though a public argument takes it; Dagster is held below 1.14.
from dagster._core.definitions.asset_checks.asset_check_evaluation import (
    AssetCheckEvaluationTargetMaterializationData,
)

from assets.metadata import rounded
from assets.scenes import SCENES, key_of
from nvsf_core.stages import Check, Outcome, Stage
from nvsf_core.stages.runner.stage import NOT_RUN, NamedCheck, UnsoundOutputError

CHECK_NAME = "output_is_sound"
"""Every asset's blocking check: it sums up all checks of the stage and lists them in its metadata. Each of
the stage's named checks is also a Dagster check of its own."""
_PUBLISHED = dg.AssetCheckSeverity.WARN
"""A published output passed its blocking checks, so other failures only warn and later stages still run."""


def check_specs(stage: Stage) -> list[dg.AssetCheckSpec]:
    """The check that sums up the stage, and one check for each of its named checks."""
    whole = dg.AssetCheckSpec(
        CHECK_NAME,
        asset=key_of(stage.name),
        blocking=True,
        partitions_def=SCENES,
        description="What the stage checked of its output; with a failed blocking one nothing is published.",
    )
    return [
        whole,
        *(
            dg.AssetCheckSpec(
                named.name,
                asset=key_of(stage.name),
                blocking=named.blocking,
                description=named.description,
                partitions_def=SCENES,
            )
            for named in stage.named_checks
        ),
    ]


def verdicts(stage: Stage, outcome: Outcome, scene: str) -> list[dict[str, Any]]:
    """Keyword arguments of an `AssetCheckResult` (or evaluation) per check of a published output."""
    whole = {
        "check_name": CHECK_NAME,
        "passed": all(check.passed for check in outcome.checks),
        "severity": _PUBLISHED,
        "description": f"scene {scene}",
        "metadata": check_metadata(outcome),
    }
    found = {check.name: check for check in outcome.checks}
    return [whole, *(_verdict(named, found.get(named.name), scene) for named in stage.named_checks)]


def reason_of(error: Exception, stage: Stage, scene: str) -> str:
    """The error's message without scene and stage, which are shown beside it."""
    return str(error).removeprefix(f"scene {scene}, stage {stage.name}: ")


def failed_verdicts(stage: Stage, scene: str, error: Exception, reason: str) -> list[dict[str, Any]]:
    """As `verdicts`, for a stage that published nothing: the failure, and the checks that ran before it."""
    whole = {"check_name": CHECK_NAME, "passed": False, "description": f"scene {scene}: {reason}"}
    judged = error.checks if isinstance(error, UnsoundOutputError) else ()
    found = {check.name: check for check in judged}
    return [
        whole,
        *(_verdict(named, found[named.name], scene) for named in stage.named_checks if named.name in found),
    ]


def _verdict(named: NamedCheck, check: Check | None, scene: str) -> dict[str, Any]:
    """As `verdicts`, of one named check. Value and limit are numbers, so that the UI plots them over time."""
    if check is None:
        reason = f"{NOT_RUN}: this output was made before the check was"
        return {
            "check_name": named.name,
            "passed": False,  # nobody knows; a warning holds nothing up
            "severity": dg.AssetCheckSeverity.WARN,
            "description": f"scene {scene}: {reason}",
        }
    numbers = {"value": check.value, "limit": check.limit}
    # A NaN cannot travel to the UI as a number; the description says it.
    metadata: dict[str, dg.MetadataValue] = {
        key: dg.MetadataValue.float(float(rounded(number)))
        for key, number in numbers.items()
        if number is not None and math.isfinite(number)
    }
    if metadata and check.unit:
        metadata["unit"] = dg.MetadataValue.text(check.unit)
    return {
        "check_name": named.name,
        "passed": check.passed,
        "severity": dg.AssetCheckSeverity.ERROR if named.blocking else dg.AssetCheckSeverity.WARN,
        "description": f"scene {scene}: {check.detail}",
        "metadata": metadata | {"scene": dg.MetadataValue.text(scene)},
    }


def check_metadata(outcome: Outcome) -> dict[str, dg.MetadataValue]:
    """Name of each check to its verdict and detail."""
    return {
        check.name: dg.MetadataValue.text(f"{'holds' if check.passed else 'FAILS'}: {check.detail}")
        for check in outcome.checks
    }


def evaluations(
    stage: str, scene: str, found: Iterable[dict[str, Any]], instance: dg.DagsterInstance
) -> Iterator[dg.AssetCheckEvaluation]:
    """Verdicts as events of the scene's partition, for what is no run of the asset."""
    target = _newest_output(stage, scene, instance)
    for verdict in found:
        yield dg.AssetCheckEvaluation(
            asset_key=key_of(stage), partition=scene, target_materialization_data=target, **verdict
        )


def _newest_output(
    stage: str, scene: str, instance: dg.DagsterInstance
) -> AssetCheckEvaluationTargetMaterializationData | None:
    """The event by which a scene's output was reported last: the UI shows no verdict of another one."""
    asked = dg.AssetRecordsFilter(asset_key=key_of(stage), asset_partitions=[scene])
    for record in instance.fetch_materializations(asked, limit=1).records:
        return AssetCheckEvaluationTargetMaterializationData(
            storage_id=record.storage_id, run_id=record.run_id, timestamp=record.timestamp
        )
    return None
