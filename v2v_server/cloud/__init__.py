"""Videos in object storage: any address that fsspec understands (the extra ``cloud``).

bucket  what lies below an address, and getting one object of it
copies  the folder of this host that objects are fetched to, once each
"""
