// A photograph, interleaved: bytes with BYTES, otherwise floats. SAMPLE converts a sample to a colour.
#ifdef BYTES
typedef uchar source_t;
#define SAMPLE(x) ((float)(x) * (1.0f / 255.0f)) // the same bits as OpenImageIO
#else
typedef float source_t;
#define SAMPLE(x) (x)
#endif
