# SPDX-License-Identifier: Apache-2.0
<#
.SYNOPSIS
Installs clsplat on Windows and runs its demo.

.DESCRIPTION
Makes an environment of Python in a folder, installs clsplat in it, lists the OpenCL devices, and trains the demo's scene.
It needs Python 3.10 or later from python.org or the Microsoft Store, and a package index. Nothing outside of the folder
changes, except in a window of an administrator: there OpenCL reads drivers from the registry only, so the CPU driver that pip
brings is entered there.

.EXAMPLE
powershell -ExecutionPolicy Bypass -File start.ps1

.EXAMPLE
powershell -ExecutionPolicy Bypass -File start.ps1 -Package C:\downloads\clsplat-0.1.0-py3-none-any.whl -Folder D:\clsplat
#>
param(
    # What pip installs: a name, a file, or the folder of a checkout. Empty: the checkout that this script lies in, or else the
    # newest version from the package index
    [string]$Package = "",
    # Folder for the environment and the demo's results
    [string]$Folder = (Join-Path $HOME "clsplat"),
    # Training steps of the demo
    [int]$Iterations = 2000
)

Set-StrictMode -Version Latest
$ErrorActionPreference = "Stop"

# Stop with a message where a program has failed: PowerShell goes on after one
function Confirm-Success([string]$What) {
    if ($LASTEXITCODE -ne 0) {
        Write-Host "start.ps1: $What failed with status $LASTEXITCODE, see above" -ForegroundColor Red
        exit 1
    }
}

# The first of Python's commands that runs a version of 3.10 or later for x86-64
function Find-Python {
    $ErrorActionPreference = "Continue"  # Windows PowerShell takes a line on standard error for an error of its own
    $test = "import platform, sys; sys.exit(not (sys.version_info >= (3, 10) and platform.machine() == 'AMD64'))"
    foreach ($command in @(@("py", "-3"), @("python"), @("python3"))) {
        if (Get-Command $command[0] -ErrorAction SilentlyContinue) {
            $rest = @($command | Select-Object -Skip 1)
            & $command[0] @rest -c $test 2>$null
            if ($LASTEXITCODE -eq 0) { return ,$command }
        }
    }
    Write-Host "start.ps1: no Python 3.10 or later for x86-64 found; install it from https://www.python.org" -ForegroundColor Red
    exit 2
}

# The window of an administrator needs the driver in the registry
function Register-Driver([string]$Library) {
    $user = [Security.Principal.WindowsPrincipal][Security.Principal.WindowsIdentity]::GetCurrent()
    $administrator = $user.IsInRole([Security.Principal.WindowsBuiltInRole]::Administrator)
    if ($administrator -and (Test-Path $Library)) {
        $vendors = "HKLM:\SOFTWARE\Khronos\OpenCL\Vendors"
        New-Item -Path $vendors -Force | Out-Null
        New-ItemProperty -Path $vendors -Name $Library -PropertyType DWord -Value 0 -Force | Out-Null
        Write-Host "entered in the registry: $Library"
    }
}

if (-not $Package) {
    $checkout = Split-Path -Parent (Split-Path -Parent $PSScriptRoot)
    $Package = if (Test-Path (Join-Path $checkout "pyproject.toml")) { $checkout } else { "clsplat" }
}
$python = Find-Python
$rest = @($python | Select-Object -Skip 1)
$environment = Join-Path $Folder "venv"
$clsplat = Join-Path $environment "Scripts\clsplat.exe"

if (-not (Test-Path (Join-Path $environment "Scripts\python.exe"))) {
    Write-Host "making $environment"
    & $python[0] @rest -m venv $environment
    Confirm-Success "making the environment"
}
Write-Host "installing $Package and what it needs (several hundred MB the first time)"
& (Join-Path $environment "Scripts\python.exe") -m pip install --upgrade --disable-pip-version-check $Package
Confirm-Success "the installation of $Package"
Register-Driver (Join-Path $environment "Library\bin\intelocl64.dll")

& $clsplat doctor
Confirm-Success "clsplat doctor"
& $clsplat demo --output (Join-Path $Folder "demo") --iterations $Iterations
Confirm-Success "the demo"
Write-Host "The trained scene is $(Join-Path $Folder 'demo\run\model.ply'), and a turntable of it lies beside it"
