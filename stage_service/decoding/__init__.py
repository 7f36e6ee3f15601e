"""Files that others made, decoded in a process of its own, with limits.

A picture of 0.4 MB may unpack to gigabytes, and a damaged one may end the process that reads it:
neither is to happen in the process that runs the lamps. `Decoder` starts the other process
(`python -m stage_service.decoding`) and checks what comes back from it.
"""

from stage_service.decoding.decoder import Decoder as Decoder
from stage_service.decoding.decoder import DecoderBusy as DecoderBusy
from stage_service.decoding.decoder import Undecodable as Undecodable
