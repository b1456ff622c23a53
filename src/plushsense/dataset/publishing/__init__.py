"""Publish a data set: a folder and a zip with metadata in several standards, checked by validators.

contents             write the published data set: shifted times, plain columns, nothing private
texts                find texts that other programs would read as something else
description          describe the package once, for all metadata files and texts
tables               write the CSV tables beside the data, the checksums and the zip
croissant, metadata  write the metadata files
checking             validate a package
package              publish: all of these steps in order
"""
