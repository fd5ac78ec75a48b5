"""The ground plane seen by cameras: poses, homographies, relative motion, lens distortion."""
