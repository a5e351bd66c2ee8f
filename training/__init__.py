"""Training of heliomap's module segmentation network."""
