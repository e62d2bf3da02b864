"""Labels of images to files, for training detectors: a module for each format."""

from fewview.writers.labels.form import Labels, ViewLabels
from fewview.writers.labels.registry import LABEL_FORMATS, write_labels

__all__ = ["LABEL_FORMATS", "Labels", "ViewLabels", "write_labels"]
