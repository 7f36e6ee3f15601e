"""What a capture needs before it can be started: its head and masks, read and checked."""

from __future__ import annotations

from collections.abc import Callable

from stage_service.captures.manager import CaptureManager
from stage_service.captures.may_light import Word
from stage_service.decoding import Decoder
from stage_service.inputs import BadInput, check_new, read_head, read_masks
from stage_service.service_models import CaptureRequest, QueueRequest
from stage_service.storage import Storage


def prepare(
    request: CaptureRequest | QueueRequest,
    captures: CaptureManager,
    storage: Storage,
    decoder: Decoder,
) -> Callable[..., str]:
    """Read the request's head and masks; returns a function that starts the capture on a word.

    Raises `BadInput`, `NotThere`, `NoStage`.
    """
    _ = captures.stage.devices  # raises without devices
    rig = captures.rig_file.rig
    head_file, folder = request.head, request.masks
    if request.upload is not None:
        if head_file is not None or folder is not None:
            raise BadInput("upload: give either upload, or head and masks")
        head_file, folder = storage.uploaded(request.upload)
    if request.pipeline is not None:
        check_new(request.pipeline, rig, head_file is not None)
    head = None if head_file is None else read_head(head_file, decoder)
    masks = None if folder is None else read_masks(folder, rig, decoder)
    follow = {} if request.pipeline is None else {"pipeline": request.pipeline.to_dict()}

    def start(word: Word, **more: str) -> str:
        extra = {**follow, **more}
        return captures.start(request.plan, head=head, masks=masks, extra=extra, word=word)

    return start
