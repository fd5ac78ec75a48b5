"""Metric maps and 3D obstacles from ordinary photographs of a floor."""

__version__ = "0.1.0"
