"""Command line of PlushSense; each verb parses options, calls a library function and prints the result."""
