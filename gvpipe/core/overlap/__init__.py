"""Which pictures show the same ground: histograms, signatures, candidates."""
