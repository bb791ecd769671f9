// The samples of a photograph with interleaved channels: bytes with BYTES, otherwise floats. SAMPLE converts a sample
// to a colour value.
#ifdef BYTES
typedef uchar source_t;
#define SAMPLE(x) ((float)(x) * (1.0f / 255.0f)) // gives the same bits as OpenImageIO
#else
typedef float source_t;
#define SAMPLE(x) (x)
#endif
