"""The pipeline: frames in, observers fed from them, results out."""
