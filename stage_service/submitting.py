"""Jobs in callers' names: submit, read, cancel, and their artifacts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from hashlib import sha256
from pathlib import Path

from reconstruction import Capture, Model
from stage_service.captures.control import Caller, Control
from stage_service.inputs import BadInput, check_kept, check_named
from stage_service.jobs.follower import JobFollower
from stage_service.jobs.pipelines import PIPELINES
from stage_service.jobs.queue import JobQueue, NoSuchJob, new_job_id
from stage_service.jobs.records import Job
from stage_service.links import check_link, check_links
from stage_service.service_models import Artifact, JobRequest


class UnknownArtifact(LookupError):
    """The model folder has no such file."""


class NotFinished(RuntimeError):
    """The capture has not completed."""


class KeyUsed(RuntimeError):
    """The caller has used this `Idempotency-Key` for another request."""

    def __init__(self, job: Job) -> None:
        super().__init__(
            f"your Idempotency-Key was used for {job.pipeline} on capture {Path(job.capture).name} "
            f"(job {job.id}), and this request differs: send another key"
        )


class ModelInUse(RuntimeError):
    """Another job, queued or running, writes the same model."""


class Submitting:
    """Submits jobs for the models under `models`; `capture_path(id)` is a capture's folder.

    While `lock` is held no job is submitted.
    """

    def __init__(
        self,
        models: Path,
        control: Control,
        queue: JobQueue,
        follower: JobFollower,
        capture_path: Callable[[str], Path],
    ) -> None:
        self._models, self._capture_path = models, capture_path
        self._control, self._queue, self._follower = control, queue, follower
        self.lock = threading.Lock()

    def submit(self, request: JobRequest, by: Caller, key: str | None = None) -> Job:
        """Enqueue a pipeline on a capture. A repeated `key` of the same caller, by their token's
        name, returns the first job. Raises `UnknownCapture`, `NotFinished`, `BadInput`,
        `ModelInUse`, `JobsUnavailable`; `KeyUsed` if the key was used for another request."""
        job = new_job_id()
        if key is not None:
            own = sha256("\0".join((by.name, key)).encode())  # NUL is in neither
            job = f"job-{own.hexdigest()[:16]}"
            with suppress(NoSuchJob):
                return self._same(self._queue.get(job), request)
        work = partial(self._submit, job, request)
        what = f"{request.pipeline.name} on {request.capture}"
        made = self._control.do(by, "job.submit", work, job, detail=what, steers=False)
        return made if key is None else self._same(made, request)

    def _same(self, job: Job, request: JobRequest) -> Job:
        """The job, if it is the request's. Raises `KeyUsed`."""
        pipeline, wanted = request.pipeline, self._models / (request.model or job.id)
        timeout_s = pipeline.timeout_s
        theirs = (pipeline.name, pipeline.options.to_dict(), pipeline.priority, pipeline.retries)
        same = (
            (job.pipeline, job.options, job.priority, job.retries) == theirs
            and Path(job.capture).name == request.capture
            and Path(job.model).name == wanted.name
            and (None if timeout_s is None else round(1000 * timeout_s))
            == (None if job.timeout_s is None else round(1000 * job.timeout_s))
        )
        if not same:
            raise KeyUsed(job)
        return job

    def _submit(self, job: str, request: JobRequest) -> Job:
        check_kept(request.capture)
        path = self._capture_path(request.capture)
        capture = Capture(path)
        if capture.manifest is None:
            raise NotFinished(f"capture {request.capture} is not finished: wait for it")
        if (outcome := capture.manifest.get("outcome")) != "completed":
            raise NotFinished(
                f"capture {request.capture} is {outcome}, not completed: resume it, or shoot again"
            )
        check_named(request.pipeline, capture.rig)
        model = Model(self._models / (request.model or job))
        check_links(f"the model {model.path.name}", model.path)
        rebuilds = "reconstruct" in PIPELINES[request.pipeline.name]
        if not rebuilds and not model.has("strands.npz"):
            raise BadInput(
                f"model: {request.pipeline.name!r} needs a model with strands, as made by "
                "'reconstruct'"
            )
        with self.lock:
            other = self._queue.at_work_on(model)
            if other not in (None, job):  # itself: enqueued by the same key
                raise ModelInUse(
                    f"model {model.path.name}: job {other} writes it: wait, or cancel it"
                )
            made = self._queue.submit(request.pipeline, path, model, job=job)
        self._follower.follow(job)
        return made

    def latest(self, limit: int, offset: int = 0) -> list[Job]:
        """The latest `limit` jobs after the `offset` newest, newest first."""
        return self._queue.all(limit=limit, offset=offset)

    def get(self, job_id: str) -> Job:
        """A job's present state. Raises `NoSuchJob`, `JobsUnavailable`."""
        try:
            return self._queue.get(job_id)
        except NoSuchJob:  # the job of a capture that has just completed may be pending
            return self._follower.enqueue_now(job_id) or self._queue.get(job_id)

    def cancel(self, job_id: str, by: Caller) -> Job:
        """Cancel a job: a queued one at once, a running one at its next progress call."""

        def work() -> Job:
            return self._queue.cancel(self.get(job_id).id)  # `get` enqueues a pending one

        return self._control.do(by, "job.cancel", work, job_id, steers=False)

    def artifacts(self, job_id: str) -> list[Artifact]:
        """The files in the job's model folder. Raises `NoSuchJob`, `LeadsOutside`."""
        sizes = self._model_of(job_id).sizes()
        return [Artifact(path=name, bytes=size) for name, size in sizes.items()]

    def artifact(self, job_id: str, path: str) -> Path:
        """A file of the job's model folder. Raises `NoSuchJob`, `UnknownArtifact`,
        `LeadsOutside`."""
        file = self._model_of(job_id).artifacts().get(path)
        if file is None:
            raise UnknownArtifact(f"job {job_id} has no file {path!r}")
        return file

    def _model_of(self, job_id: str) -> Model:
        model = Model(self.get(job_id).model)
        check_link(f"the model {model.path.name}", model.path)
        return model
