"""Whether a session still has the detector that it was opened with."""

from __future__ import annotations

from robosac.audit.events import DetectorChanged
from robosac.calibrated import calibration_digest, screening_for
from robosac.detectors import DetectorInfo
from service.keeping.record import SessionRecord

OTHER_WEIGHTS = (
    "the gateway was started again with other weights, or another calibration, of the session's detector; its operator "
    "may allow it (ROBOSAC_ALLOW_OTHER_WEIGHTS):"
)


def has_changed(record: SessionRecord, info: DetectorInfo) -> bool:
    """Whether a detector has other weights or another calibration than the session's, where these are known."""
    if record.weights_digest is None:
        return False
    return record.digests != (info.weights_digest, calibration_digest(info))


def detector_changed(info: DetectorInfo, *, accepted: bool) -> DetectorChanged:
    """What goes on record of a detector that is not the session's."""
    return DetectorChanged(
        detector=info.name,
        weights_digest=info.weights_digest,
        calibration_digest=calibration_digest(info),
        screening={name: bounds.as_json() for name, bounds in screening_for(info).bounds.items()},
        accepted=accepted,
    )
