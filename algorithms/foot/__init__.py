"""Foot-mounted inertial navigation: detectors, strapdown, filters, aids."""
