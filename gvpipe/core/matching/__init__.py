"""From two pictures to their ground homography: features, hypotheses, refinement, verdict."""
