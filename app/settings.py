"""Every setting of the service, frozen; the only place that reads the environment.

A setting ``rate_hz`` is the variable ``KINECAST_RATE_HZ``, or a file ``kinecast_rate_hz`` in the
folder of secrets. Units are part of the name.
"""

import difflib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, SecretStr, ValidationError
from pydantic.fields import FieldInfo
from pydantic_settings import BaseSettings, SettingsConfigDict

PREFIX = "KINECAST_"
TEST_PREFIX = "KINECAST_TEST_"
"""Variables of the test suite; the service ignores them."""
SECRETS_VARIABLE = "KINECAST_SECRETS_DIR"
CLIENT_KEY_VARIABLE = "KINECAST_KEY"
"""Variable of the commands that call a service (`demo`, `bench`): their API key."""
DEFAULT_SECRETS_DIR = Path("/run/secrets")
HISTORY_MIN_DAYS = 1.0
"""So that whatever is in use is marked as used several times before it could be forgotten."""

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class BadSettingsError(ValueError):
    """A setting is unknown or wrong; the message names it and what to do."""


class Settings(BaseSettings):
    """The settings, in the order in which the documentation lists them."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="forbid")

    # Where the service lives.
    host: str = Field("127.0.0.1", description="Address that the service listens on.")
    port: int = Field(8000, ge=0, le=65535, description="Port; 0 takes any free one.")
    data_dir: Path = Field(
        Path("var"), description="Folder of the SQLite database and of generated secrets."
    )
    database_url: str | None = Field(
        None,
        description="PostgreSQL as `postgresql://user:password@host/name`; "
        "without it, SQLite in `data_dir`.",
    )
    database_pool: Count = Field(5, description="Most open connections to the database.")
    database_timeout_s: Positive = Field(
        5.0, description="Longest wait for a connection or a lock of the database."
    )
    redis_url: str | None = Field(
        None,
        description="Redis as `redis://host:6379/0`, which carries hints between processes; "
        "without it they look for news as often as they poll.",
    )
    admin_key: SecretStr | None = Field(
        None,
        description="Bootstrap admin key, at least 32 characters; "
        "without it the first start makes one and shows it once.",
    )
    audit_key: SecretStr | None = Field(
        None,
        description="Secret under which the audit log keeps the ids of erased users; "
        "without it, one is kept in `data_dir`. Replicas of one database need the same.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe log line that is written."
    )
    log_format: Literal["auto", "console", "json"] = Field(
        "auto", description="`auto` is readable text on a terminal and JSON lines elsewhere."
    )
    drain_s: Annotated[float, Field(ge=0)] = Field(
        5.0, description="Longest wait for open streams to say goodbye at shutdown."
    )

    # Forecasting.
    model: Path | None = Field(
        None, description="Weights to serve in place of the shipped base model (safetensors)."
    )
    engine_threads: Count = Field(1, description="Threads of the forecasting engine's arithmetic.")
    device: str = Field(
        "auto",
        description="Where forecasts are computed: `cpu`, a device as torch names it (`cuda`), or "
        "`auto`: a GPU where torch finds one.",
    )
    engine_batch: Count = Field(64, description="Most windows that one batch takes.")
    forecast_queue: Count = Field(
        256, description="Most single forecasts in flight; one more is answered `overloaded`."
    )
    max_age_ms: Positive = Field(
        200.0, description="Default age beyond which a stream's frame gets no forecast."
    )
    coverage: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.9, description="Default probability that the true joint lies within `radius`."
    )

    # What counts as a window.
    neighbour_max_ms: Positive = Field(
        100.0, description="Longest step between frames that is bridged linearly."
    )
    missing_max_ms: Positive = Field(
        100.0, description="Longest absence of a joint before it is carried and listed."
    )
    window_min_s: Positive = Field(
        0.45, description="Span of frames at which a window is complete."
    )
    gap_s: Positive = Field(0.5, description="Gap in a stream that empties its window.")
    confidence_min: Fraction = Field(
        0.3, description="Confidence below which a joint counts as missing."
    )
    coordinate_max_m: Positive = Field(100.0, description="Largest coordinate that is accepted.")
    torso_min_m: Positive = Field(0.25, description="Shortest plausible torso.")
    torso_max_m: Positive = Field(0.9, description="Longest plausible torso.")
    frozen_poses: Count = Field(
        10, description="Identical poses in a row that count as a frozen sensor."
    )

    # Limits, as published by GET /v1/limits.
    max_message_bytes: Annotated[int, Field(ge=4096)] = Field(
        262_144, description="Largest message of a stream."
    )
    max_rate_hz: Positive = Field(120.0, description="Highest frame rate of a stream.")
    idle_s: Positive = Field(30.0, description="A stream without messages is closed after this.")
    streams_per_key: Count = Field(64, description="Open streams per key and replica.")
    streams_per_user: Count = Field(8, description="Open streams per user and replica.")
    forecast_frames: Annotated[int, Field(ge=15)] = Field(
        600, description="Most frames in one forecast request."
    )
    trial_bytes: Annotated[int, Field(ge=65_536)] = Field(
        67_108_864, description="Largest body of an uploaded trial."
    )
    clips: Count = Field(500, description="Most clips of a trial.")
    frames_per_clip: Annotated[int, Field(ge=30)] = Field(
        9000, description="Most frames of a clip."
    )

    # Streams and the database.
    watch_s: Positive = Field(
        1.0, description="How often open streams look for revoked keys and erased users."
    )
    version_unconfirmed_s: Positive = Field(
        10.0, description="Without a database for this long, forecasts are flagged."
    )
    version_unconfirmed_close_s: Positive = Field(
        60.0, description="Without a database for this long, streams are closed."
    )
    recording_keep_s: Positive = Field(
        10.0, description="A live recording waits this long for a database that is away."
    )
    recording_abandoned_s: Annotated[float, Field(ge=20)] = Field(
        60.0, description="A recording without a stream for this long is stored without a job."
    )

    # Fine-tuning.
    finetune_threads: Count = Field(1, description="Threads of one fine-tuning run.")
    finetune_nice: Annotated[int, Field(ge=0, le=19)] = Field(
        10, description="How far fine-tuning steps back behind forecasting (Unix niceness)."
    )
    finetune_steps: Count | None = Field(
        None,
        description="Optimisation steps of one fit; without it, as many as the recipe was judged "
        "with. Fewer are faster, and win less often.",
    )
    finetune_timeout_s: Positive = Field(
        900.0, description="A fine-tuning run that takes longer is ended and tried again."
    )
    worker_poll_s: Positive = Field(1.0, description="How often an idle worker looks for a job.")
    lease_s: Positive = Field(
        30.0, description="A worker that is silent for this long has lost its job to the next one."
    )
    heartbeat_s: Positive = Field(5.0, description="How often a worker renews its lease.")
    versions_kept: Annotated[int, Field(ge=0)] = Field(
        10,
        description="Newest versions of a user whose weights are kept; "
        "the active one and its parent always are.",
    )
    history_kept_days: Annotated[float, Field(ge=HISTORY_MIN_DAYS)] = Field(
        90.0,
        description="How long jobs that made no version, and session names that nobody uses, "
        "are remembered.",
    )
    parse_timeout_s: Positive = Field(
        30.0, description="Longest time to read the files of one upload."
    )
    parse_bytes: Annotated[int, Field(ge=268_435_456)] = Field(
        2_147_483_648, description="Most memory for reading the files of one upload."
    )


def read_client_key() -> str | None:
    """Give the API key of the environment for commands that call a service."""
    return os.environ.get(CLIENT_KEY_VARIABLE) or None


def make_environment(**settings: object) -> dict[str, str]:
    """Make the environment of a service of one's own, apart from whatever database is configured.

    Args:
        settings: what it is to have, beside the rest of the environment.
    """
    ours = {
        f"{PREFIX}{name}" for name in ("DATABASE_URL", "REDIS_URL", "ADMIN_KEY", "DATA_DIR", "PORT")
    }
    kept = {name: value for name, value in os.environ.items() if name.upper() not in ours}
    return kept | {f"{PREFIX}{name.upper()}": str(value) for name, value in settings.items()}


class SettingDoc(NamedTuple):
    """One row of the documentation's table of settings."""

    variable: str
    default: str
    sentence: str


def list_settings() -> list[SettingDoc]:
    """List every setting with its variable, default and meaning, in their order."""
    return [_document(name, field) for name, field in Settings.model_fields.items()]


def load_settings(environ: Mapping[str, str] | None = None, **overrides: object) -> Settings:
    """Read the settings from the environment and the folder of secrets.

    Args:
        environ: variables to check for unknown names; the process's own by default.
        overrides: values that win over the environment; None leaves the setting alone.

    Raises:
        BadSettingsError: for an unknown ``KINECAST_`` variable or a value that does not fit.
    """
    variables = os.environ if environ is None else environ
    _refuse_unknown(variables)
    secrets = _find_secrets(variables)
    given: dict[str, Any] = {name: value for name, value in overrides.items() if value is not None}
    try:
        return Settings(_secrets_dir=secrets, **given)
    except ValidationError as error:
        raise BadSettingsError(_explain(error)) from None


def _find_secrets(variables: Mapping[str, str]) -> Path | None:
    if SECRETS_VARIABLE not in variables:
        return DEFAULT_SECRETS_DIR if DEFAULT_SECRETS_DIR.is_dir() else None
    folder = Path(variables[SECRETS_VARIABLE])
    if not folder.is_dir():
        raise BadSettingsError(f"{SECRETS_VARIABLE}: there is no folder {folder}.")
    return folder


def _refuse_unknown(variables: Mapping[str, str]) -> None:
    names = [name.upper() for name in Settings.model_fields]
    known = {PREFIX + name for name in names} | {SECRETS_VARIABLE, CLIENT_KEY_VARIABLE}
    for variable in sorted(variables):
        upper = variable.upper()
        if not upper.startswith(PREFIX) or upper.startswith(TEST_PREFIX) or upper in known:
            continue
        close = difflib.get_close_matches(upper[len(PREFIX) :], names, n=1)
        hint = f" Did you mean {PREFIX}{close[0]}?" if close else ""
        raise BadSettingsError(f"Unknown setting {variable}.{hint}")


def _explain(error: ValidationError) -> str:
    """Name each wrong setting, without its value: it may be a secret."""
    return " ".join(
        f"{PREFIX}{'_'.join(str(part) for part in problem['loc']).upper()}: {problem['msg']}."
        for problem in error.errors(include_input=False, include_url=False)
    )


def _document(name: str, field: FieldInfo) -> SettingDoc:
    default = "" if field.default is None else str(field.default)
    return SettingDoc(f"{PREFIX}{name.upper()}", default, field.description or "")
