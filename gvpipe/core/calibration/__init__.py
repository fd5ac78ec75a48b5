"""Intrinsics from boards and from the ground itself."""
