"""One file a command: reads records, calls :mod:`gvpipe.core`, returns and writes one artefact."""
