"""From posed pictures to the obstacles' surfaces: evidence, energy, level sets, meshes."""
