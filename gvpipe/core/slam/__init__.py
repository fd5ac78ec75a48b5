"""From links between pictures to one metric map: placement, loops, adjustment, covariance."""
