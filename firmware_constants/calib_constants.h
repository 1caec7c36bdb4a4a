/*
 * calib_constants.h - constants of one rig, written by calib 0.1.0. Do not edit.
 *
 * SHA-256 of the values: 31777472957751c12e0ff992f6a72408378ddcf509593e4ad4c12d6041b90cec
 * input camera/board.yaml: f77bc61378d4ff28baac9883646ca1bf8dc43576acf495b4800377effe06e39b
 * input camera/view01.png: a8a5d43cd237c318df2372ece67ce52fa2a09171cff9447bb68af2394a832c30
 * input camera/view02.png: 74159ff201b50cc6f7316fa06817c34155aa126f4f03cb7415b51f5489fcb730
 * input camera/view03.png: 1e369415755ab0b924c7236dca9bdf332aca8be5bb68ddf818d59c942605e415
 * input camera/view04.png: e9d91a773d97ce5c53b2bea4e23b0a6ed371ec2e62d70c4faa86d1576784efbb
 * input camera/view05.png: 9278b83b56c07436fc6079f944e72314f91713074f10fcd0e8a876f53723229b
 * input camera/view06.png: 43d4534f98877424c8e68f1a70b5d91e50c70f477a75ce2abda14f40e87f0ac9
 * input camera/view07.png: 61e84709886a47574f230abc1e676c9a8407d1a02d777ca39e3bbac6dd32c079
 * input camera/view08.png: 76c72909c2921f2bbe04cd85f6bc084f169f3c1b86aa413831356863fdac9f72
 * input camera/view09.png: a8d5eece4f3fb471b2895cc3a092d1dc5f2cb8e601593f8f88e8ec6c80429b15
 * input camera/view10.png: f82054cc4e9f401af60f1666dcda452f451d075c5b24eea941daf143910ef5cd
 * input camera/view11.png: 5e064dce5391b24ad1694317c5a19d0d548441d1525ab5d1cda52955f9c1ba74
 * input camera/view12.png: 2917823a01da9780f16cb5f3d999ff99af59b059a7d42fd1b9842542faf6a100
 * input camera/view13.png: 30d82152c5dacb409692e35d0a711e56636578ed29d65a567cd535b9014eddc8
 * input camera/view14.png: 229ba1a6266915468f2ad6b07df98549c84894228c8c20570a604f7d908dbfcc
 * input camera/view15.png: a3a47ad3a959862a0e0411ba26011e2335c24b3034ac870014badcfce50a40bd
 * input camera/view16.png: 39cdb1fa7ec12742b9d19a36925f40f605e0f96a7074c4124a291493c9fc77d4
 * input camera/view17.png: d079e58065fbda9899912b44411c49c55d19ef4ee0e826188525af37167011fe
 * input plane/board.yaml: cc046d6ef28e4ce45c9c8a661650f7a1bd43c1536ffc4840447c90ae18b616bf
 * input plane/plane01.png: 44ce3bea1b9432ad86f014168bb8dcd05d8f275edf8efd43c6c8d1c4fe0cc711
 * camera: radial2, verdict ok
 * plane: verdict ok
 *
 * Pixels: (0, 0) is the centre of the top-left pixel, u right, v down. World: metres, x right and y
 * down in the picture, z away from the camera.
 */
#ifndef CALIB_CONSTANTS_H
#define CALIB_CONSTANTS_H

#include <float.h>

#if FLT_RADIX != 2 || FLT_MANT_DIG != 24 || FLT_MAX_EXP != 128
#error "calib: float has to be IEEE 754 binary32"
#endif

#define CALIB_SCHEMA 1
#if defined(CALIB_EXPECT_SCHEMA) && CALIB_EXPECT_SCHEMA != CALIB_SCHEMA
#error "calib: this header has another schema than the code expects"
#endif

/* First 32 bits of the SHA-256 of the values, to tell calibrations apart in telemetry. */
#define CALIB_ID 0x31777472UL

#define CALIB_IMAGE_WIDTH_PX 316
#define CALIB_IMAGE_HEIGHT_PX 208
#define CALIB_CAMERA_OK 1 /* 0: the calibration failed its gate */

/* Camera (2.5) and lens (B.1). */
#define CALIB_CAMERA_FX_PX 273.409546f /* focal length along u, px; sigma_mu of (2.5) */
#define CALIB_CAMERA_FY_PX 272.603973f /* focal length along v, px; sigma_nu of (2.5) */
#define CALIB_CAMERA_SKEW_PX 0.0f /* skew, px; gamma of (2.5) */
#define CALIB_CAMERA_CX_PX 160.670013f /* principal point, px from the centre of the left column; mu_0 of (2.5) */
#define CALIB_CAMERA_CY_PX 101.869606f /* principal point, px from the centre of the top row; nu_0 of (2.5) */
#define CALIB_CAMERA_K1 -0.220018402f /* lens, dimensionless, OpenCV's order and signs */
#define CALIB_CAMERA_K2 0.549356937f /* lens, dimensionless, OpenCV's order and signs */

/*
 * Inverse lens, normalised coordinates: yd = (v - cy) / fy, xd = (u - cx - skew yd) / fx, then
 * x = xd P, y = yd P with P = 1 + c1 r2 + c2 r2^2 + ..., r2 = xd^2 + yd^2.
 * Error at most 0.0012 px over 100 % of the picture.
 */
#define CALIB_LENS_INVERSE_ORDER 5
#define CALIB_LENS_DECENTERING_STEPS 0
#define CALIB_LENS_INVERSE_C1 0.217687085f /* coefficient of r2^1, dimensionless */
#define CALIB_LENS_INVERSE_C2 -0.333740503f /* coefficient of r2^2, dimensionless */
#define CALIB_LENS_INVERSE_C3 -1.56922519f /* coefficient of r2^3, dimensionless */
#define CALIB_LENS_INVERSE_C4 3.4366219f /* coefficient of r2^4, dimensionless */
#define CALIB_LENS_INVERSE_C5 -2.06394172f /* coefficient of r2^5, dimensionless */

/* Plane of the actuator. */
#define CALIB_HAS_PLANE 1
#define CALIB_PLANE_OK 1 /* 0: the plane failed its gate */
#define CALIB_PLANE_INVERSE_11 0.00365899038f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_12 -8.8428118e-05f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_13 -0.59911108f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_21 7.93001309e-05f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_22 0.00362181547f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_23 -0.160717785f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_31 -0.000315899641f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_32 -0.000872946228f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */
#define CALIB_PLANE_INVERSE_33 3.76397467f /* entry of A^-1, undistorted px to m; (2.11), the last row gives 1/s of (2.12) */

#endif /* CALIB_CONSTANTS_H */
