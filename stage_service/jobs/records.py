"""Jobs and their requests, as everything outside the worker has them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from appearance import FieldRequest, InverseRenderingRequest
from appearance.metrics.decision import MATERIAL, STAGES, FitStage, with_needed
from appearance.model.options import AssessOptions
from appearance.sun_fit.options import FitOptions
from reconstruction import ReconstructOptions
from reconstruction.deprecated import new_name
from reconstruction.methods import Method
from stage_service.config import Names, Text
from stage_service.device_config import Strict
from stage_service.jobs.pipelines import PIPELINES
from stage_service.plan.person_text import ONE_LINE

JobState = Literal["queued", "running", "done"]
JobOutcome = Literal["succeeded", "failed", "cancelled"]


def with_example(**fields: Any) -> ConfigDict:
    """Frozen, no other fields, and an example in the schema."""
    return ConfigDict(extra="forbid", frozen=True, json_schema_extra={"examples": [fields]})


class JobOptions(Strict):
    """Options of a pipeline.

    `held_out_cameras` and `held_out_lights` are excluded from reconstruction and fit; their images
    validate the result. `label` is shown on the model's page. `truth` is a strand file to evaluate
    against, with baselines of strands unless `baselines` is false, or a folder with `strands.npz`
    and `appearance.json`; `environment` a `.hdr` or `.exr` file, `studio` or `sky`. With `reduced`
    n every step works on means over n × n pixels. `stages` are those of the fit; one that starts
    from another includes it.
    `reconstruct`, `fit`, `inverse_rendering`, `fields` and `assess` are the options of the step of
    that name; those of `assess` include the relit pictures'.
    """

    method: Method = "light_planes"
    compress: bool = True
    held_out_cameras: Names = ()
    held_out_lights: Names = ()
    reduced: int = Field(default=1, ge=1, le=64)
    baselines: bool = True
    label: Annotated[str, Text, Field(max_length=200), ONE_LINE] = ""
    environment: str = "studio"
    truth: str | None = None
    seed: int = Field(default=0, ge=0, lt=2**32)
    stages: Annotated[tuple[FitStage, ...], Field(min_length=1)] = STAGES
    reconstruct: ReconstructOptions = Field(default_factory=ReconstructOptions)
    fit: FitOptions = Field(default_factory=FitOptions)
    inverse_rendering: InverseRenderingRequest = Field(default_factory=InverseRenderingRequest)
    fields: FieldRequest = Field(default_factory=FieldRequest)
    assess: AssessOptions = Field(default_factory=AssessOptions)

    @model_validator(mode="before")
    @classmethod
    def _variant_as_stages(cls, given: Any) -> Any:
        """Read `inverse_rendering.fit.variant`, which names the last of its stages."""
        try:
            last = given["inverse_rendering"]["fit"]["variant"]
        except (KeyError, TypeError):
            return given
        names = ["shared" if last == "original" else last]
        if last in MATERIAL:
            names = [*MATERIAL[: MATERIAL.index(last) + 1]]
        fields = [name for name in given.get("stages", ()) if name == "field"]
        inverse = given["inverse_rendering"]
        fit = {key: value for key, value in inverse["fit"].items() if key != "variant"}
        stages = {new_name("options", "inverse_rendering.fit.variant"): ["sun", *names, *fields]}
        return {**given, **stages, "inverse_rendering": {**inverse, "fit": fit}}

    @field_validator("stages")
    @classmethod
    def _with_needed(cls, stages: tuple[FitStage, ...]) -> tuple[FitStage, ...]:
        return with_needed(stages)

    @field_validator("reconstruct")
    @classmethod
    def _job_options_alone(cls, options: ReconstructOptions) -> ReconstructOptions:
        if options.held_out or options.seed:
            raise ValueError("set the job's held_out_cameras and seed instead of held_out and seed")
        return options

    def to_dict(self) -> dict[str, Any]:
        """The options that differ from the defaults, as JSON."""
        return self.model_dump(mode="json", exclude_defaults=True)


class PipelineRequest(Strict):
    """A pipeline to run, and its options.

    The queued job of the lowest `priority` runs first. A failed step is retried `retries` times; a
    job fails after running for `timeout_s` seconds.
    """

    name: Annotated[str, Field(json_schema_extra={"enum": sorted(PIPELINES)})]
    options: JobOptions = JobOptions()
    priority: int = Field(default=5, ge=0, le=9)
    retries: int = Field(default=0, ge=0, le=5)
    timeout_s: float | None = Field(default=None, ge=0.1, le=30 * 86400.0)

    def to_dict(self) -> dict[str, Any]:
        """The request as JSON that makes it again."""
        rest = self.model_dump(mode="json", exclude_defaults=True, exclude={"options"})
        return {"name": self.name, "options": self.options.to_dict(), **rest}

    @field_validator("name")
    @classmethod
    def _known(cls, name: str) -> str:
        name = new_name("pipeline", name)
        if name not in PIPELINES:
            raise ValueError(f"there is no pipeline {name!r}; there are {sorted(PIPELINES)}")
        return name


class JobProgress(Strict):
    """A job's progress, 0 to 1: `share` of the whole job, by the usual durations of its steps, and
    `step_share` of this step."""

    step: str
    steps: tuple[str, ...]
    what: str
    share: float
    step_share: float


class JobError(Strict):
    """Why a job failed: the error's class and its message."""

    type: str
    detail: str


class Job(BaseModel):
    """One run of a pipeline. `outcome` is set exactly when `state` is `done`; times are UTC.

    `options` are the request's, without defaults; so are `priority`, `retries` and `timeout_s`.
    """

    model_config = with_example(
        id="job-20261121-093000-1f2e",
        pipeline="reconstruct",
        state="running",
        capture="/data/stage/captures/20261121-093000-1f2e",
        model="/data/stage/models/20261121-093000-1f2e",
        options={"held_out_cameras": ["cam_07"]},
        priority=5,
        retries=0,
        progress={
            "step": "reconstruct",
            "steps": ["reconstruct", "evaluate", "results"],
            "what": "tracing strands",
            "share": 0.23,
            "step_share": 0.7,
        },
        created="2026-11-21T09:31:12.000+00:00",
        started="2026-11-21T09:31:13.000+00:00",
    )

    id: str
    pipeline: str
    state: JobState
    outcome: JobOutcome | None = None
    capture: str
    model: str
    options: dict[str, Any]
    priority: int
    retries: int
    timeout_s: float | None = None
    progress: JobProgress | None = None
    error: JobError | None = None
    created: str
    started: str | None = None
    finished: str | None = None
