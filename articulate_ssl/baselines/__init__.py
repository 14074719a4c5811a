"""Methods to compare with, scored by the same metrics.

A baseline is one file. It offers a function from the labels of a batch (`points` and whatever the method may know) to
a `Prediction`, and a `main` that runs it over the test split of a set, updates `ArticulatedPoseMetrics` with every
batch (calibrated on `perfect_oracle` where its canonical spaces are the labelled ones, else on its own predictions of
training clouds) and hands the result to `write_report`, with `checkpoint=None` and `method` as its name. Then
`python -m articulate_ssl.baselines.<file>` gives a report that reads like a network's; nothing else has to know of it.
"""
