"""A prediction to look at and to move: in a browser beside this program (`live`), or as one file (`html_page`)."""
