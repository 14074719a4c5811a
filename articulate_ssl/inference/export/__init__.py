"""What a prediction leaves on disk: one file for each thing that is written, each with `write(result, folder)`.

To write something else, add a file with `write(result: ScanPrediction, folder: Path) -> list[Path]` and name it in
`formats.FORMATS` and `folder.EXPORTERS_BY_NAME`; what moves reads `rigid_links`, which sets the conventions once.
"""
