"""From posed pictures to the overhead map: raster, exposure, composition, occupancy."""
