"""Images made ready to be measured together: sky, noise and PSF of each."""

from dataclasses import replace

import numpy as np

from ..coaddition.resampling.pixel_maps import map_exposure
from ..exceptions import InputError
from ..inputs.frames.working_units import in_working_unit, noise_unit
from ..measurement.positions import measure_exposure
from ..measurement.profiles import frame_fit, moffat
from ..measurement.profiles.cutouts import Stamps, box_half
from ..measurement.profiles.location import locate_stars
from ..measurement.scene.joint_fit import Scene
from ..measurement.scene.moffat_field import MoffatField
from .joint_scene import Layer
from .places import Places

_CORE = 1.3  # FWHM: the light of the outermost stars that determined a map counts


def read_layer(exposure, view, grid, options):
    """The `Layer` of an image, without stars, or the reason why it cannot be used.

    Parameters
    ----------
    exposure : Exposure or ExposureFile
    view : `~legdistort.results.view.View`
        Its own.
    grid : `~legdistort.coaddition.grids.Grid`
        Of the reference plane.
    options : `~legdistort.measurement.options.MeasureOptions`
    """
    name, psf = exposure.name, _psf(exposure.name, view, options)
    exposure = options.with_detector(exposure.read())
    unit = noise_unit(exposure)
    exposure = in_working_unit(exposure, unit)
    options = replace(options, gain=None, saturation=None)  # the exposure has them
    frame, centres, shape = locate_stars(exposure, threshold=options.threshold, fwhm=options.fwhm, known=True)
    if centres is not None and not len(centres):
        return "no star is seen in it"
    width = float(moffat.fwhm(shape))
    half = options.box // 2 if options.box else box_half(width)
    photon = frame.photon
    if photon is None:
        photon = frame_fit.photon_noise(Stamps(frame, centres, half), shape)
    places = Places(view)
    frame = replace(frame, good=frame.good & places.supported(frame.good.shape, _CORE * width), sky=None, levels=None)
    if psf == "effective":
        psf = measure_exposure(exposure, replace(options, psf="effective")).psf
        if psf is None:
            return "it has too few stars for an effective PSF"
    retuned = isinstance(psf, str)
    scene = Scene(frame, MoffatField.constant(shape, frame.signal.shape) if retuned else psf, half, photon)
    return Layer(name, scene, places, map_exposure(view, grid), unit, shape, retuned)


def _psf(name, view, options):
    """What an image is measured with: "moffat", "effective" or a PSF; by default as its positions were."""
    psf = options.psf_of(name)
    if not isinstance(psf, str) or psf != "auto":
        return psf
    rows = view.residuals
    known = set(np.asarray(rows["psf"]).astype(str)) if "psf" in rows.colnames else {"moffat"}
    if strange := known - {"moffat", "effective"}:
        raise InputError(
            f"exposure {name}: its positions were measured with the PSF {strange.pop()}; give it as psf= (--psf), or "
            "psf='moffat'"
        )
    return "effective" if "effective" in known else "moffat"
