"""Client of the heliomap service: upload a survey, follow its mapping, fetch the plant as GeoJSON."""

from .client import Client
from .connection import HeliomapError, Problem, Unreachable
from .upload import UploadReport, survey_files

__all__ = ["Client", "HeliomapError", "Problem", "Unreachable", "UploadReport", "survey_files"]
