"""Scripts that generate the shipped assets. After a change, run the script and commit the files that it writes."""
