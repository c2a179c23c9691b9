"""Run time against error: scenes x methods x settings -> results.jsonl, work-precision plots, a table of equal-error speed-ups.

`config` is the TOML file; `references` computes and keeps what is right; `runners` runs a method of ours, one that is
named as "module:function", or a bake; `peer` runs Mitsuba 3 where it is installed; `measure` takes seconds and memory;
`errors` and `report` turn pictures into numbers and tables, `plots` into figures; `driver` does all of it in order, in
processes of `workers`, and goes on where it was stopped.
"""
