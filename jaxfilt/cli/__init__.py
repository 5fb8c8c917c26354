"""What ``python -m jaxfilt`` is made of: files in, filters learnt from them, reports out."""
