"""One folder per published method; each has `claims`, `plan` and `render`, and none imports another."""
