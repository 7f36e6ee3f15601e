"""Untrusted files, decoded in a separate process with limits.

An image of 0.4 MB may unpack to gigabytes, and a damaged one may crash its reader, which must not
happen in the process that runs the lamps. `Decoder` starts the other process
(`python -m stage_service.decoding.server`) and validates its responses.
"""

from stage_service.decoding.decoder import Decoder as Decoder
from stage_service.decoding.decoder import DecoderBusy as DecoderBusy
from stage_service.decoding.decoder import Undecodable as Undecodable
