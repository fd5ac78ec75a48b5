"""Made-up scenes with exact truth."""
